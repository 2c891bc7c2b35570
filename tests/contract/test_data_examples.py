"""The examples that `--help` prints, run as printed on recordings of the names that they use."""

import os
import re
import shlex
import shutil
import textwrap

import numpy as np
import pytest
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.cli import main
from cqn_data.operations.registry import OPERATIONS

from .. import foreign_formats
from .data_recording import RECIPE

NAMES = ["pan.pos", "lift.pos", "gripper.pos"]
# The network; a minute of simulation, which the walk through the docs has; a page that waits for a person.
ELSEWHERE = {"push", "record", "review"}
OUTPUTS = ("--new_root", "--html", "--preview", "--report")


def examples(operation, capsys):
    """Commands below "Example:", one list of arguments each."""
    assert main([operation, "--help"]) == 0
    page = capsys.readouterr().out
    block = textwrap.dedent(re.search(r"Example:\n((?:  .*\n)+)", page).group(1))
    lines = block.replace("\\\n", " ").strip().splitlines()
    assert lines, f"{operation} --help shows no example"
    assert all(line.startswith("cqn-data ") for line in lines)
    return [shlex.split(line.partition(" > ")[0])[1:] for line in lines]  # a shell sends the output on


def record(root, fps, shape, episodes, steps):
    """A moving arm with pauses, whose commands lead it a little."""
    vector = {"dtype": "float32", "shape": (3,), "names": NAMES}
    camera = {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector, "observation.images.top": camera}
    encoder = RGBEncoderConfig(vcodec="h264")
    dataset = LeRobotDataset.create("local/x", fps, features, root=root, rgb_encoder=encoder)
    rng = np.random.default_rng(0)
    for _ in range(episodes):
        state = np.zeros(3, np.float32)
        for step in range(steps):
            move = np.float32([0, 0, 0] if 8 <= step < 14 else [*rng.uniform(0.03, 0.05, 2), 0])
            picture = np.full(shape, 5 * step, np.uint8)
            frame = {"observation.state": state.copy(), "action": state + 1.2 * move, "observation.images.top": picture}
            dataset.add_frame({**frame, "task": "x"})
            state = state + move
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A working folder with what the examples read."""
    folder = tmp_path_factory.mktemp("desk")
    record(folder / "data/click", 10, (48, 64, 3), 8, 24)
    record(folder / "data/pick", 30, (480, 640, 3), 12, 16)
    shutil.copytree(folder / "data/pick", folder / "data/pick_more")
    (folder / "my_recipe.yaml").write_text(RECIPE)
    foreign_formats.write_rlbench(folder / "rlbench_data/open_drawer")
    (folder / "lift").mkdir()
    foreign_formats.write_robomimic(folder / "lift/image.hdf5")
    before = os.getcwd()
    os.chdir(folder)
    names = ["--repo_id=local/pick", "--root=data/pick", "--new_repo_id=local/pick_delta", "--new_root=data/pick_delta"]
    assert main(["delta", *names]) == 0
    yield folder
    os.chdir(before)


@pytest.mark.parametrize("operation", [name for name in OPERATIONS if name not in ELSEWHERE])
def test_examples_work_as_printed(operation, desk, capsys):
    for arguments in examples(operation, capsys):
        dry = any(a.startswith("--dry_run") for a in arguments)
        wanted = [] if dry else [a.partition("=")[2] for a in arguments if a.startswith(OUTPUTS)]
        for path in wanted:  # an earlier example may have used the place
            if os.path.exists(path):
                os.rename(path, f"{path}.{os.urandom(4).hex()}")
        code = main(arguments)
        assert code == 0, f"cqn-data {shlex.join(arguments)}\n{capsys.readouterr().err}"
        assert all(os.path.exists(path) for path in wanted)


@pytest.mark.parametrize("operation", sorted(ELSEWHERE & set(OPERATIONS)))
def test_the_other_operations_show_examples_too(operation, capsys):
    assert examples(operation, capsys)
