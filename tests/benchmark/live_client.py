"""One who looks at a run's page without drawing: takes every frame as it comes.

python -m tests.benchmark.live_client URL
"""

import asyncio
import sys

from websockets.asyncio.client import connect


def opened(url, **more):
    """Connect to the page's server as the page does."""
    address, _, token = url.partition("#")
    place = address.removeprefix("http://").rstrip("/")
    names = ["hilctl.live.1", f"token.{token}"]
    settings = {"origin": f"http://{place}", "subprotocols": names, "proxy": None, **more}
    return connect(f"ws://{place}/live", **settings)


async def main():
    async with opened(sys.argv[1], max_size=None) as connection:
        frames = 0
        async for message in connection:
            frames += isinstance(message, bytes)
            if frames == 10:
                print("frames come", flush=True)


if __name__ == "__main__":
    asyncio.run(main())
