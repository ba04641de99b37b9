"""What a sweep varies: from words like `width=64,128` to distributions of optuna, and to options of `carom learn`."""

import contextlib
import dataclasses
import io
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import tyro

from carom.checks import require
from carom.errors import CaromError
from carom.learning.config import LearnConfig

OPTIONS = tuple(f.name for f in dataclasses.fields(LearnConfig) if f.name not in ("learn", "checkpoint_every"))
"""Options of a training that a sweep may vary."""


@dataclasses.dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, both included; whole ones if both are. `log`: evenly in their logarithm."""

    low: int | float
    high: int | float
    log: bool

    def distribution(self) -> Any:
        """As optuna has it."""
        import optuna

        if isinstance(self.low, int) and isinstance(self.high, int):
            return optuna.distributions.IntDistribution(self.low, self.high, log=self.log)
        return optuna.distributions.FloatDistribution(self.low, self.high, log=self.log)


@dataclasses.dataclass(frozen=True)
class Choices:
    """Values to choose from."""

    values: tuple[Any, ...]

    def distribution(self) -> Any:
        """As optuna has it."""
        import optuna

        return optuna.distributions.CategoricalDistribution(self.values)


Space = Mapping[str, Range | Choices]


def parse_space(words: Sequence[str]) -> Space:
    """What is varied, by the name of the option: `NAME=A,B,C`, `NAME=LOW:HIGH` or `NAME=LOW:HIGH:log`.

    **Raises:** `CaromError` for words of another form, unknown options, and values that an option cannot have.
    """
    require(len(words) > 0, "--over must name what to vary, such as width=64,128,256 learning_rate=1e-4:1e-2:log.")
    space: dict[str, Range | Choices] = {}
    for word in words:
        name, sign, values = word.partition("=")
        name = name.strip().replace("-", "_")
        require(
            bool(sign and values),
            f"--over must be of the form NAME=A,B,C or NAME=LOW:HIGH or NAME=LOW:HIGH:log; it was {word!r}.",
        )
        require(name in OPTIONS, f"--over can vary {', '.join(OPTIONS)}; it was {name!r}.")
        require(name not in space, f"--over names {name} twice.")
        space[name] = _range(name, word, values) if ":" in values else _choices(name, values)
    return space


def grid(space: Space) -> list[dict[str, Any]]:
    """All combinations of a space of choices.

    **Raises:** `CaromError` if it has ranges.
    """
    ranges = [name for name, values in space.items() if isinstance(values, Range)]
    require(not ranges, f"--method grid needs lists of values (NAME=A,B,C); {', '.join(ranges)} had a range.")
    choices = {name: values.values for name, values in space.items() if isinstance(values, Choices)}
    return [dict(zip(choices, combination, strict=True)) for combination in itertools.product(*choices.values())]


def _choices(name: str, values: str) -> Choices:
    found = tuple(_value(name, value.strip()) for value in values.split(","))
    require(len(set(found)) == len(found), f"--over names a value of {name} twice: {values}.")
    return Choices(found)


def _range(name: str, word: str, values: str) -> Range:
    low, high, *rest = [part.strip() for part in values.split(":")]
    require(rest in ([], ["log"]), f"--over has ranges NAME=LOW:HIGH or NAME=LOW:HIGH:log; it was {word!r}.")
    ends = [_value(name, end) for end in (low, high)]
    require(
        all(isinstance(end, int | float) and not isinstance(end, bool) for end in ends),
        f"{name} is not a number: give its values as a list, NAME=A,B,C; it was {word!r}.",
    )
    require(ends[0] < ends[1], f"the range of {name} must go from the lower number to the higher; it was {values!r}.")
    require(not rest or ends[0] > 0, f"a logarithmic range starts above 0; that of {name} was {values!r}.")
    return Range(ends[0], ends[1], bool(rest))


def _value(name: str, text: str) -> Any:
    """A value of an option, read as `carom learn` reads it."""
    try:
        config = LearnConfig(**{name: _typed(name, text)})
        config.check()
    except CaromError as error:
        raise CaromError(f"over: {error}") from error
    return getattr(config, name)


def _typed(name: str, text: str) -> Any:
    if isinstance(getattr(LearnConfig, name), bool):
        require(text in ("True", "False"), f"{name} must be True or False; it was {text!r}.")
        return text == "True"
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            read = tyro.cli(LearnConfig, args=[f"--{name.replace('_', '-')}", text])
    except SystemExit as error:
        raise CaromError(f"{text!r} is no value of {name}; `carom learn --help-all` says what is.") from error
    return getattr(read, name)


def words_of(config: LearnConfig) -> list[str]:
    """The options of `carom learn` that make this configuration of the default one."""
    words: list[str] = []
    for field in dataclasses.fields(LearnConfig):
        value, name = getattr(config, field.name), field.name.replace("_", "-")
        if value == field.default:
            continue
        if isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{name}")
        elif isinstance(value, tuple):
            words += [f"--{name}", *value]
        else:
            words += [f"--{name}", str(value)]
    return words
