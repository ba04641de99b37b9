"""What long work shows while it runs: a live bar on a terminal, a line now and then in a log."""

import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class LoopProgress:
    """Shows how far a loop has come, and a text. Use it as a context manager; if not `shown`, it says nothing."""

    def __init__(self, name: str, total: int, start: int = 0, console: Console | None = None, *, shown: bool = True):
        self.console = console or Console(stderr=True)
        self.name, self.total, self.start, self.shown = name, total, start, shown
        self.every = max(1, total // 10)
        self.live = Progress(
            TextColumn(f"{name} {{task.completed:.0f}}/{{task.total:.0f}}"),
            BarColumn(bar_width=24),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[text]}"),
            console=self.console,
            disable=not (shown and self.console.is_terminal),
        )

    def __enter__(self):
        self.begun = time.monotonic()
        self.live.start()
        self.bar = self.live.add_task("", total=self.total, completed=self.start, text="compiling ...")
        return self

    def __exit__(self, *_):
        self.live.stop()

    def update(self, done: int, text: str) -> None:
        """Show that `done` rounds are done, and a text about the last of them."""
        self.live.update(self.bar, completed=done, text=text)
        now_and_then = done % self.every == 0 or done in (1, self.total)
        if self.shown and not self.console.is_terminal and now_and_then:
            seconds = time.monotonic() - self.begun
            self._print(f"{self.name} {done}/{self.total}  {seconds:.0f} s  {text}")

    def say(self, text: str) -> None:
        """Show what is done beside the rounds."""
        self.live.update(self.bar, text=text)
        if self.shown and not self.console.is_terminal:
            self._print(text)

    def _print(self, text: str) -> None:
        self.console.print(text, soft_wrap=True, highlight=False)


def training_text(metrics: dict[str, Any]) -> str:
    """One epoch's losses and contact properties."""
    parts = [f"loss {metrics['loss']:.2e}", f"validation {metrics['val_loss']:.2e}"]
    for name in ("friction", "restitution"):
        values = metrics[name]
        if not values:  # a network is in its place
            continue
        mean = sum(values) / max(len(values), 1)
        parts.append(f"{name} {mean:.4f}" if len(values) == 1 else f"mean {name} {mean:.3f}")
    if "epsilon" in metrics:
        parts.append(f"epsilon {metrics['epsilon']:.2e}")
    return "  ".join(parts)
