"""What is said of refused images."""

import pytest

from cpcbl_agents.input_diagnosis.problems import InputFacts, InputWindow, input_problems


@pytest.mark.parametrize(
    ("refused", "said"),
    [
        ({"camera_upside_down": 40}, ()),  # the camera says it in a line of its own
        ({"frame_black": 40}, ("100 % of frame refused: images are black",)),
        (
            {"camera_upside_down": 30, "frame_black": 10},
            ("25 % of frame refused: images are black",),
        ),
    ],
)
def test_what_the_camera_says_itself_is_not_said_twice(
    refused: dict[str, int], said: tuple[str, ...]
) -> None:
    windows = {"frame": InputWindow(0.0, came=True, refused=refused)}
    assert input_problems(InputFacts("r1", windows)) == said
