"""A progress line on the terminal for what takes over two seconds, and silence where nobody looks."""

import contextlib
import sys
from collections.abc import Iterator


class Progress:
    """One bar per task on stderr; `step` matches the `progress(name, done, total)` of `fit` and `adapt`."""

    def __init__(self, bar=None):
        self.bar = bar
        self.tasks: dict[str, int] = {}

    def task(self, name: str, total: int | None = None):
        """Start a task; the returned function takes (done, total)."""
        if (bar := self.bar) is None:
            return lambda done, total: None
        task = self.tasks[name] = bar.add_task(name, total=total)
        return lambda done, total: bar.update(task, completed=done, total=total)

    def done(self, name: str) -> None:
        if self.bar is not None and name in self.tasks:
            self.bar.update(self.tasks[name], total=1, completed=1)


@contextlib.contextmanager
def progress_bar() -> Iterator[Progress]:
    """A rich progress display on stderr where that is a terminal; else nothing."""
    if not sys.stderr.isatty():
        yield Progress()
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        yield Progress(bar)
