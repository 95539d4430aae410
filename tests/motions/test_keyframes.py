"""Key frames: equal results from JSON and CSV, a one-line error for every malformed entry, and the curve through the
keys."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.motions.keyframes import Quantity, channels, read_keyframes

GOOD = {"time": 0.5, "part": "head", "quantity": "position", "value": [0.1, 0, -0.05]}
HEADER = "time,part,quantity,x,y,z\n"


def written(folder: Path, name: str, content: object) -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_json_and_csv_are_equivalent(tmp_path: Path) -> None:
    entries = [GOOD, {"time": 1.0, "part": "body", "quantity": "orientation", "value": [0, 0, 30], "weight": 2}]
    from_json = read_keyframes(written(tmp_path, "k.json", entries))
    from_csv = read_keyframes(
        written(
            tmp_path,
            "k.csv",
            "time, part, quantity, x, y, z, weight\n"
            "0.5, head, position, 0.1, 0, -0.05,\n\n"
            "1, body, orientation, 0, 0, 30, 2\n",
        )
    )
    assert [(k.time, k.part, k.quantity, k.value, k.weight) for k in from_json] == [
        (k.time, k.part, k.quantity, k.value, k.weight) for k in from_csv
    ]
    assert from_csv[1].where.endswith("k.csv, line 4")


def test_curve_passes_through_keys_starts_at_rest_and_never_overshoots(tmp_path: Path) -> None:
    entries = [{**GOOD, "time": t, "value": [x, 0, 0]} for t, x in ((0.4, 0.2), (0.8, 0.2), (1.5, 0.5))]
    (channel,) = channels(read_keyframes(written(tmp_path, "k.json", entries)))
    assert channel.quantity is Quantity.POSITION
    assert np.allclose([channel.at(t)[0][0] for t in (0.0, 0.4, 0.8, 1.5, 9.0)], [0.0, 0.2, 0.2, 0.5, 0.5])
    times = np.linspace(0.0, 1.5, 400)
    values = np.array([channel.at(t)[0][0] for t in times])
    assert np.diff(values).min() > -1e-12
    rates = np.array([channel.at(t)[1][0] for t in times[:-1]])
    assert np.abs(rates - np.diff(values) / np.diff(times)).max() < 0.02
    assert channel.at(1.6)[1][0] == 0.0


def test_the_second_derivative_is_that_of_the_curve(tmp_path: Path) -> None:
    """Between two keys, the second derivative equals the difference quotient of the rates; after the last key it is
    zero."""
    (channel,) = channels(
        read_keyframes(written(tmp_path, "k.json", [GOOD, {**GOOD, "time": 1.0, "value": [0, 0, 0]}]))
    )
    step = 1e-5
    for time in (0.2, 0.7):
        difference = (channel.at(time + step)[1] - channel.at(time - step)[1]) / (2.0 * step)
        assert channel.second_rate(time) == pytest.approx(difference, rel=1e-6, abs=1e-9)
    assert np.array_equal(channel.second_rate(1.0), np.zeros(3))


def test_feet_have_numbers(tmp_path: Path) -> None:
    path = written(tmp_path, "k.csv", HEADER + "0.5,foot 12,position,0,0,0.1\n0.5,foot,position,0,0,0.1\n")
    assert [k.part for k in read_keyframes(path)] == ["foot 12", "foot"]


def test_a_weight_applies_until_its_key(tmp_path: Path) -> None:
    entries = [{**GOOD, "time": t, "weight": w} for t, w in ((0.5, 1), (1.0, 9), (2.0, 4))]
    (channel,) = channels(read_keyframes(written(tmp_path, "k.json", entries)))
    assert [channel.weight_at(t) for t in (0.0, 0.5, 0.51, 1.0, 1.9, 2.0, 7.0)] == [1, 1, 9, 9, 4, 4, 4]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not JSON"),
        ({"time": 1}, "give a list of keys, each an object with time, part, quantity, value"),
        ([], "no key frames; give at least one"),
        ([3], "key 1: 3 is not an object with time, part, quantity, value"),
        ([{k: v for k, v in GOOD.items() if k != "part"}], 'key 1: "part" is missing'),
        (
            [GOOD, {**GOOD, "time": 1, "speed": 3}],
            'key 2: "speed" is unknown; a key has time, part, quantity, value, weight',
        ),
        (
            [{**GOOD, "part": "tail"}],
            "key 1: part 'tail' is unknown; give one of body, base, head, foot, or a numbered part: foot 1, ",
        ),
        ([{**GOOD, "part": "foot 0"}], "key 1: part 'foot 0' is unknown"),
        ([{**GOOD, "part": ["head"]}], "key 1: part ['head'] is unknown"),
        (
            [{**GOOD, "quantity": "mood"}],
            "quantity 'mood' is unknown; give one of position, velocity, orientation, angular_momentum",
        ),
        ([{**GOOD, "time": "soon"}], "key 1: time 'soon': give seconds above 0, at most 60"),
        ([{**GOOD, "time": True}], "key 1: time True: give seconds above 0, at most 60"),
        ([{**GOOD, "time": 0}], "key 1: time 0: give seconds above 0, at most 60"),
        ([{**GOOD, "value": [1, 2]}], "key 1: value [1, 2]: give three numbers: forward, left, up"),
        ([{**GOOD, "value": [1, 2, None]}], "key 1: value [1, 2, None]: give three numbers: forward, left, up"),
        ([{**GOOD, "time": 10**401}], "key 1: time inf: give seconds above 0, at most 60"),
        (
            [{**GOOD, "time": 1e-320}],
            "key 1: time 9.99989e-321 is less than 0.001 s after the start of head position at 0 s",
        ),
        ([{**GOOD, "value": [0, 10**401, 0]}], "key 1: value [0, inf, 0]: give three numbers"),
        (f'[{{"time": {5000 * "9"}}}]', 'key 1: "part" is missing'),
        ([{**GOOD, "value": 4}], "key 1: value 4: give three numbers: forward, left, up"),
        ([{**GOOD, "value": [0, 30, 40]}], "value [0, 30, 40] has the length 50; at most 10 is allowed"),
        (
            [{**GOOD, "quantity": "orientation", "value": [0, 0, -361]}],
            "key 1: value [0, 0, -361] has the length 361; at most 360 is allowed",
        ),
        ([{**GOOD, "weight": 0}], "key 1: weight 0: give a number above 0, at most 1000"),
        ([GOOD, GOOD], "key 2: time 0.5 is less than 0.001 s after the previous key of head position at 0.5 s"),
    ],
)
def test_malformed_json(tmp_path: Path, content: object, message: str) -> None:
    path = written(tmp_path, "k.json", content)
    with pytest.raises(UserError) as error:
        read_keyframes(path)
    assert str(error.value).startswith(str(path))
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "no key frames; give at least one"),
        (HEADER, "no key frames; give at least one"),
        (
            "time,part,x,y,z\n",
            "line 1: the columns are time,part,x,y,z; give time,part,quantity,x,y,z and optionally weight",
        ),
        (HEADER + "0.5,head,position,1,2\n", "line 2: 5 values for 6 columns; give one for each"),
        (
            HEADER + "0.5,head,position,1,2,up\n",
            "line 2: value [1.0, 2.0, 'up']: give three numbers: forward, left, up",
        ),
        (HEADER + "now,head,position,0,0,0\n", "line 2: time 'now': give seconds above 0, at most 60"),
        (HEADER + f"1,head,position,0,0,{401 * '1'}\n", "line 2: value [0.0, 0.0, inf]: give three numbers"),
        (HEADER + 131073 * "1", "not CSV (field larger than field limit (131072)); correct the file"),
        (HEADER + "1,head,position,0,0,nan\n", "line 2: value [0.0, 0.0, nan]: give three numbers"),
    ],
)
def test_malformed_csv(tmp_path: Path, content: str, message: str) -> None:
    path = written(tmp_path, "k.csv", content)
    with pytest.raises(UserError) as error:
        read_keyframes(path)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"key frames are read from \.json or \.csv"):
        read_keyframes(tmp_path / "k.txt")
    with pytest.raises(UserError, match=r"none.csv: no such file or folder; check the path"):
        read_keyframes(tmp_path / "none.csv")
    with pytest.raises(UserError, match=r"a\\x00.json: cannot be read"):
        read_keyframes(Path("a\0.json"))
    (tmp_path / "k.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not a text file"):
        read_keyframes(tmp_path / "k.json")
