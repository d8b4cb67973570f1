"""What the title of a comparison's figure says of what is drawn."""

from __future__ import annotations

import numpy as np

from service.offline.compare.report import describe_shown_time


def test_a_figure_of_some_seconds_says_which_and_of_how_many() -> None:
    all_s = np.arange(0.0, 20.0, 0.01)
    said = describe_shown_time(all_s[(all_s > 3.0) & (all_s < 7.0)], all_s)
    assert said.startswith("over time: 3.0 to 7.0 s, of 0.0 to 20.0 s that were compared")
    assert describe_shown_time(all_s, all_s) == "over time: all that was compared, 0.0 to 20.0 s"
