"""What a training shows while it runs: a live bar on a terminal, a line now and then in a log."""

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class TrainingProgress:
    """Shows epochs, losses and contact properties. Use it as a context manager."""

    def __init__(self, epochs: int, start: int = 0, console: Console | None = None):
        self.console = console or Console(stderr=True)
        self.epochs, self.start = epochs, start
        self.every = max(1, epochs // 10)
        self.live = Progress(
            TextColumn("epoch {task.completed:.0f}/{task.total:.0f}"),
            BarColumn(bar_width=24),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[text]}"),
            console=self.console,
            disable=not self.console.is_terminal,
        )

    def __enter__(self):
        self.live.start()
        self.bar = self.live.add_task("", total=self.epochs, completed=self.start, text="compiling ...")
        return self

    def __exit__(self, *_):
        self.live.stop()

    def update(self, metrics: dict[str, Any]) -> None:
        """Show one epoch's metrics."""
        parts = [f"loss {metrics['loss']:.2e}", f"validation {metrics['val_loss']:.2e}"]
        for name in ("friction", "restitution"):
            values = metrics[name]
            if not values:  # a network is in its place
                continue
            mean = sum(values) / max(len(values), 1)
            parts.append(f"{name} {mean:.4f}" if len(values) == 1 else f"mean {name} {mean:.3f}")
        if "epsilon" in metrics:
            parts.append(f"epsilon {metrics['epsilon']:.2e}")
        text = "  ".join(parts)
        epoch = metrics["epoch"]
        self.live.update(self.bar, completed=epoch, text=text)
        if not self.console.is_terminal and (epoch % self.every == 0 or epoch in (1, self.epochs)):
            self.console.print(
                f"epoch {epoch}/{self.epochs}  {metrics['seconds']:.0f} s  {text}", soft_wrap=True, highlight=False
            )

    def say(self, text: str) -> None:
        """Show what is done after the epochs."""
        self.live.update(self.bar, text=text)
        if not self.console.is_terminal:
            self.console.print(text, highlight=False)
