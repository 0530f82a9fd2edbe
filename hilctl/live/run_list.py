"""Keep readers of the active runs: add them when a run starts, remove them when it has ended."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress

from hilctl.base.errors import RunError
from hilctl.live.run_reader import RunReader
from hilctl.run.control.client import active_runs
from hilctl.run.run_folder import RunFolder

_LOOK_S = 1.0


class RunList:
    """Readers of the active runs, each created when it is first requested.

    Args:
        chosen: Returns the run to show if none is named; None if there is none.

    Attributes:
        runs: All active runs.
    """

    def __init__(self, chosen: Callable[[list[RunFolder]], RunFolder | None]) -> None:
        self.runs: list[RunFolder] = []
        self._chosen = chosen
        self._feeds: dict[str, RunReader] = {}
        self._main = ""
        self._looked_s = float("-inf")

    def __iter__(self) -> Iterator[RunReader]:
        """Iterate over the readers that were requested."""
        return iter(self._feeds.values())

    def look(self, now_s: float, shown: Iterable[str | None] = ()) -> None:
        """Update the list of active runs once per second; remove ended runs that are not shown.

        Args:
            now_s: Monotonic time.
            shown: Names of the runs that are shown; None for the main one.
        """
        if now_s - self._looked_s < _LOOK_S:
            return
        self._looked_s, self.runs = now_s, active_runs()
        kept = {self._main} | {
            feed.folder.card.name for name in shown if (feed := self.feed(name)) is not None
        }
        self._feeds = {
            name: feed for name, feed in self._feeds.items() if not feed.ended or name in kept
        }

    def feed(self, name: str | None) -> RunReader | None:
        """Return the reader of a run that is active, or was when first requested."""
        if name is None:
            name = self._main = self._main_run()
        if name in self._feeds:
            return self._feeds[name]
        found = next((run for run in self.runs if run.card.name == name), None)
        if found is not None:
            with suppress(RunError):  # the run is just being started or removed
                self._feeds[name] = RunReader(found)
        return self._feeds.get(name)

    def _main_run(self) -> str:
        """Return the default run; an ended run remains until there is another."""
        feed = self._feeds.get(self._main)
        if feed is not None and not feed.ended:
            return self._main
        chosen = self._chosen(self.runs)
        return self._main if chosen is None else chosen.card.name
