"""The live view of a run: stage, chunk, runs per second, running means. Plain lines where there is no terminal."""

import sys
import time
from types import TracebackType

from emt.reports.numbers import value_and_error


class LiveView:
    """Shows the progress of one experiment; a context manager whose `update` takes `emt.runner.Progress`."""

    QUIET_SECONDS = 10.0
    """Without a terminal, at most one line in this time, besides changes of stage."""

    def __init__(self, name: str, metric: str):
        from rich.console import Console

        self.name, self.metric = name, metric
        self.console = Console(stderr=True)
        self.live = None
        self.started = time.perf_counter()
        self._last = ("", 0.0)

    def __enter__(self) -> "LiveView":
        from rich.live import Live

        if self.console.is_terminal:
            self.live = Live(console=self.console, refresh_per_second=8, transient=True)
            self.live.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.live is not None:
            self.live.stop()

    def update(self, progress) -> None:
        """Shows where the run stands."""
        if self.live is not None:
            self.live.update(self.panel(progress))
            return
        stage, when = self._last
        now = time.perf_counter()
        if progress.stage != stage or now - when > self.QUIET_SECONDS:
            self._last = (progress.stage, now)
            print(f"{self.name}: {self.line(progress)}", file=sys.stderr, flush=True)

    def line(self, progress) -> str:
        """Progress in one line."""
        elapsed = time.perf_counter() - self.started
        parts = [progress.stage, progress.detail, f"{progress.done}/{progress.total} runs"]
        if progress.runs_per_second:
            parts.append(f"{progress.runs_per_second:.0f} runs/s")
        return ", ".join(part for part in parts if part) + f", {elapsed:.0f} s"

    def panel(self, progress):
        """Progress as a bar with the running means under it."""
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.spinner import Spinner
        from rich.table import Table
        from rich.text import Text

        head = Table.grid(padding=(0, 1))
        head.add_row(
            Spinner("dots"),
            Text(self.name, style="bold"),
            ProgressBar(total=progress.total, completed=progress.done, width=30),
            self.line(progress),
        )
        body = Table.grid(padding=(0, 2))
        for label, (mean, error, failed) in progress.running.items():
            value, shown = value_and_error(mean, error)
            lost = f"{failed} failed" if failed else ""
            body.add_row("   ", label, self.metric, f"{value} ± {shown}", lost)
        return Group(head, body)
