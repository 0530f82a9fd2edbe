"""The runs that a server shows: found as they start, let go once they are over."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress

from hilctl.base.errors import RunError
from hilctl.desk.feed import RunFeed
from hilctl.run.client import going_on
from hilctl.run.run_folder import RunFolder

_LOOK_S = 1.0


class RunFeeds:
    """Feeds of the runs that are going on, each from when it is first asked for.

    Args:
        chosen: Returns the run that is shown where none is named; None where there is none.

    Attributes:
        runs: All that are going on.
    """

    def __init__(self, chosen: Callable[[list[RunFolder]], RunFolder | None]) -> None:
        self.runs: list[RunFolder] = []
        self._chosen = chosen
        self._feeds: dict[str, RunFeed] = {}
        self._main = ""
        self._looked_s = float("-inf")

    def __iter__(self) -> Iterator[RunFeed]:
        """Iterate over those that were asked for."""
        return iter(self._feeds.values())

    def look(self, now_s: float, shown: Iterable[str | None] = ()) -> None:
        """Look once a second which runs there are, and let go of those over that nobody looks at.

        Args:
            now_s: Monotonic time.
            shown: Names of the runs that are looked at; None for the main one.
        """
        if now_s - self._looked_s < _LOOK_S:
            return
        self._looked_s, self.runs = now_s, going_on()
        kept = {self._main} | {
            feed.folder.card.name for name in shown if (feed := self.feed(name)) is not None
        }
        self._feeds = {
            name: feed for name, feed in self._feeds.items() if not feed.ended or name in kept
        }

    def feed(self, name: str | None) -> RunFeed | None:
        """Return the feed of a run that is going on, or was when it was first asked for."""
        if name is None:
            name = self._main = self._main_run()
        if name in self._feeds:
            return self._feeds[name]
        found = next((run for run in self.runs if run.card.name == name), None)
        if found is not None:
            with suppress(RunError):  # being started or removed at this moment
                self._feeds[name] = RunFeed(found)
        return self._feeds.get(name)

    def _main_run(self) -> str:
        """Return the run of those who name none; one that is over stays until there is another."""
        feed = self._feeds.get(self._main)
        if feed is not None and not feed.ended:
            return self._main
        chosen = self._chosen(self.runs)
        return self._main if chosen is None else chosen.card.name
