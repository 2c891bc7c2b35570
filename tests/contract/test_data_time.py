"""Rates that are no whole numbers, time stamps that do not begin at 0 or drift, videos of another length or rate."""

import json
import shutil
from fractions import Fraction

import av
import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.disk.timing import distances
from lerobot_cqn.errors import DataError

from .columns import ACTION, STATE, TOP, edit_info, edit_rows, edit_table, grey, moving, write_columns
from .data_recording import column, last_line, run
from .test_data_inspect import inspect

FPS, STEPS, LEVEL = 10, 24, 4


def level(dataset, row):
    """Number that the picture of a row shows, and the episode: grey levels of the second begin elsewhere."""
    value = float(dataset[row][TOP].mean()) * 255
    return round((value - 20) / LEVEL)


def episodes(steps=STEPS):
    return [
        {STATE: moving(steps, seed=s), ACTION: moving(steps, seed=s) + 1, TOP: grey(steps, start=20 + 100 * s)}
        for s in (0, 1)
    ]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write_columns(tmp_path_factory.mktemp("time") / "src", episodes())


def stamped(recording, root, change, fps=None):
    """A copy whose time stamps are a function of frame and episode."""
    shutil.copytree(recording, root)

    def write(columns):
        pairs = zip(columns["frame_index"], columns["episode_index"], strict=True)
        columns["timestamp"] = [change(frame, episode) for frame, episode in pairs]

    edit_rows(root, write)
    if fps:
        edit_info(root, lambda info: info.update(fps=fps))
    return root


def right_pictures(root, first=0):
    """LeRobot itself finds the picture of every row; in the second episode it begins 25 levels later."""
    dataset = LeRobotDataset("local/dst", root, video_backend="pyav")
    steps = len(dataset) // 2
    shown = [level(dataset, row) for row in range(len(dataset))]
    assert shown == [*range(first, first + steps), *range(25 + first, 25 + first + steps)]
    return dataset


OPERATIONS = [["label", "--all"], ["trim", "--head=5"], ["resize", "--size=[32,32]"]]


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda o: o[0])
@pytest.mark.parametrize(
    "change",
    [
        lambda frame, episode: (frame + 4) / FPS,
        lambda frame, episode: 100.0 + frame / FPS,
        lambda frame, episode: frame * 1.08 / FPS,
        lambda frame, episode: frame / FPS + 0.004 * (frame % 3),
        lambda frame, episode: frame / FPS + 5.0 * episode,
    ],
    ids=["late", "clock", "slow", "jitter", "goes_on"],
)
def test_rows_keep_their_pictures_whatever_a_clock_said(recording, tmp_path, operation, change):
    root = stamped(recording, tmp_path / "src", change)
    assert inspect(root)["time_stamps"].level == "error"
    run(operation[0], root, tmp_path / "dst", *operation[1:])
    right_pictures(tmp_path / "dst", 5 if operation[0] == "trim" else 0)
    assert "time_stamps" not in inspect(tmp_path / "dst")
    np.testing.assert_allclose(column(tmp_path / "dst", "timestamp")[:3], [0, 0.1, 0.2], atol=1e-6)


def test_inspect_has_nothing_to_say_of_what_lerobot_wrote(recording):
    assert not {"time_stamps", "no_picture"} & set(inspect(recording))


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda o: o[0])
@pytest.mark.parametrize("rate", [29.97, 23.976, 12.5])
def test_rates_that_are_no_whole_numbers_stay(tmp_path, operation, rate):
    root = write_columns(tmp_path / "src", episodes(), fps=int(rate))
    stamp = stamped(root, tmp_path / "stamped", lambda frame, _: frame / rate, rate)
    encode(stamp, rate)

    def at_this_rate(columns):
        for name, rows in (("from_timestamp", "dataset_from_index"), ("to_timestamp", "dataset_to_index")):
            columns[f"videos/{TOP}/{name}"] = [row / rate for row in columns[rows]]

    places(stamp, at_this_rate)
    dataset = run(operation[0], stamp, tmp_path / "dst", *operation[1:])
    assert dataset.meta.fps == rate
    right_pictures(tmp_path / "dst", 5 if operation[0] == "trim" else 0)
    np.testing.assert_allclose(np.diff(column(tmp_path / "dst", "timestamp")[:10]), 1 / rate, atol=1e-5)
    info = json.loads((tmp_path / "dst/meta/info.json").read_text())
    assert info["features"][TOP]["info"]["video.fps"] in (rate, int(rate))
    assert "time_stamps" not in inspect(tmp_path / "dst")
    run("resample", stamp, tmp_path / "slower", "--fps=5")
    assert LeRobotDataset("local/dst", tmp_path / "slower").meta.fps == 5


def encode(root, rate, keep=lambda pictures: pictures):
    """Encode a recording's video anew, without some pictures or at another rate."""
    path = next((root / "videos").rglob("*.mp4"))
    with av.open(str(path)) as container:
        pictures = keep(list(container.decode(video=0)))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", Fraction(rate).limit_denominator(1001), options={"crf": "1", "g": "2"})
        stream.height, stream.width, stream.pix_fmt = 48, 48, "yuv420p"
        for number, picture in enumerate(pictures):
            picture.pts, picture.time_base = number, 1 / stream.codec_context.framerate
            picture.pict_type = av.video.frame.PictureType.NONE
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def places(root, change):
    """Change the columns of the table of episodes."""
    for path in (root / "meta/episodes").rglob("*.parquet"):
        edit_table(path, change)


def test_a_video_that_ends_early_is_named_by_inspect_and_by_copying(recording, tmp_path, capsys):
    root = tmp_path / "src"
    shutil.copytree(recording, root)
    encode(root, FPS, keep=lambda pictures: pictures[:-2])
    assert "frame 22" in inspect(root)["no_picture"].text
    run("label", root, tmp_path / "no", "--all", code=2)
    assert "episode 1, frame 22" in last_line(capsys)
    run("trim", root, tmp_path / "cut", "--tail=2")
    right_pictures(tmp_path / "cut")
    dataset = run("label", root, tmp_path / "one", "--all", "--skip_bad_episodes")
    assert dataset.num_episodes == 1
    assert "Left out episode 1" in capsys.readouterr().err


def test_a_video_of_another_rate_is_named(recording, tmp_path, capsys):
    root = tmp_path / "src"
    shutil.copytree(recording, root)
    encode(root, 5, keep=lambda pictures: pictures[::2])
    assert "come at 5 a second, the rows at 10" in inspect(root)["no_picture"].text
    for number, operation in enumerate(OPERATIONS):
        run(operation[0], root, tmp_path / str(number), *operation[1:], code=2)
        assert "episode 0, frame" in last_line(capsys)


def test_rows_beyond_the_pictures_of_their_episode_are_named(recording, tmp_path, capsys):
    root = tmp_path / "src"
    shutil.copytree(recording, root)

    def shorter(columns):
        columns[f"videos/{TOP}/to_timestamp"][0] -= 3 / FPS

    places(root, shorter)
    run("resize", root, tmp_path / "no", "--size=[32,32]", code=2)
    assert "the pictures of episode 0 end at 2.100 s, before frame 21" in last_line(capsys)


def test_each_row_has_a_picture_of_its_own(tmp_path):
    pictures = np.arange(10) / 10
    assert distances(tmp_path, pictures, pictures[2:6] + 0.001, 10, 0).max() == pytest.approx(0.001)
    for wanted, said in ((pictures + 0.5, "no picture at 1.000 s"), (np.array([0.1, 0.14, 0.3]), "have one picture")):
        with pytest.raises(DataError, match=said):
            distances(tmp_path, pictures, wanted, 10, 0)
    with pytest.raises(DataError, match="has no pictures"):
        distances(tmp_path, np.zeros(0), pictures, 10, 0)
    assert distances(tmp_path, np.zeros(1), np.zeros(1), 10, 0).tolist() == [0]
