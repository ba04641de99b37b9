"""The picture of what data tell: which marks stand where."""

import dataclasses

import numpy as np
import pytest
from PIL import Image
from systems import refused

from carom.learning.estimation.identify import Estimate, Identification
from carom.view.estimates import _limits, _panel, draw_estimates
from carom.view.style import BLUE, MUTED, new_figure, theme

FRICTION = [
    Estimate(0.5, 0.01, 0.48, 0.52, "identified", 40),
    Estimate(0.3, 5.0, 0.0, 10.1, "not identified", 3),
    Estimate(0.7, np.inf, 0.62, np.inf, "bounded below", 5, 0.62),
]
FOUND = Identification([50] * 3, [50] * 3, [40] * 3, [5] * 3, FRICTION, [], [], 100)


def test_marks_stand_where_the_numbers_are():
    axes = new_figure(3.0, 2.0).subplots()
    _panel(axes, FRICTION, ["a", "b", "c"], [0.51, 0.4, 0.8], BLUE)
    lines = [(*(np.asarray(data) for data in line.get_data()), line.get_color()) for line in axes.get_lines()]

    def there(x, y, color):
        return any(len(lx) == 2 and np.allclose([lx, ly], [x, y]) and c == color for lx, ly, c in lines)

    low, high = axes.get_xlim()
    assert there([0.48, 0.52], [2, 2], BLUE)
    assert there([0.0, high], [1, 1], MUTED)  # an interval that leaves the axis is cut off there
    assert there([0.62, high], [0, 0], BLUE)
    assert [label.get_text() for label in axes.get_yticklabels()] == ["c", "b", "a"]
    assert low < 0 < high < 1


def test_the_axis_holds_what_is_told_and_the_truth():
    low, high = _limits(FRICTION, [0.5, 0.3, 1.5])
    assert low < 0
    assert 1.5 < high < 2


@pytest.mark.parametrize("name", ["light", "dark"])
def test_it_is_written(tmp_path, name):
    with theme(name):
        path = draw_estimates(FOUND, ["a", "b", "c"], tmp_path / "p.png", truth={"friction": [0.5, 0.3, 0.8]})
    with Image.open(path) as image:
        corner = image.convert("L").getpixel((1, 1))
        assert image.size[0] > 400
    assert isinstance(corner, int)
    assert (corner > 200) == (name == "light")
    with refused("found has no estimate"):
        draw_estimates(dataclasses.replace(FOUND, friction=[]), [], tmp_path / "p.png")
