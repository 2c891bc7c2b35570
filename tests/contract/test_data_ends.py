"""Where demonstrations end: by success, by done, by a single reward; what is said of rewards at every step."""

import numpy as np
import pytest

from cqn_data.decisions.rewards import demonstration_end
from cqn_train.config import DatasetSettings
from cqn_train.replay.demonstrations import Demonstrations
from lerobot_cqn.schema import NEXT_DONE, NEXT_REWARD, NEXT_SUCCESS

from ..unit.test_policy_batch import make_agent
from .columns import ACTION, STATE, moving, write_columns
from .data_recording import run
from .test_data_inspect import inspect

STEPS = 40


def at(*frames):
    return np.isin(np.arange(STEPS), frames)


RISING = np.linspace(0.05, 1, STEPS)
PENALTY = np.where(at(STEPS - 1), 0, -1)
# rewards, success, done -> last frame, success
ENDS = {
    "dense and success": (RISING, at(39), at(39), (39, True)),
    "dense, success early": (RISING, at(20, 21, 22), at(39), (20, True)),
    "dense and done": (RISING, None, at(30), (30, True)),
    "dense alone": (RISING, None, None, (0, True)),
    "penalties": (PENALTY, at(39), at(39), (39, True)),
    "penalties, failed": (PENALTY, at(), at(39), (39, False)),
    "sparse": (at(25), None, None, (25, True)),
    "sparse, done later": (at(25), None, at(39), (25, True)),
    "failed": (at(), None, at(39), (39, False)),
    "done before any reward": (at(30, 31), None, at(10), (30, True)),
    "nothing": (None, None, None, (39, True)),
    "success alone": (None, at(12), None, (12, True)),
}


def judged(reward, success, done):
    columns = {NEXT_REWARD: reward, NEXT_SUCCESS: success, NEXT_DONE: done}
    kinds = {NEXT_REWARD: np.float32, NEXT_SUCCESS: bool, NEXT_DONE: bool}
    return {k: np.asarray(v, kinds[k])[:, None] for k, v in columns.items() if v is not None}


@pytest.mark.parametrize("kind", ENDS)
def test_the_end_of_a_demonstration(kind):
    *columns, wanted = ENDS[kind]
    assert demonstration_end(judged(*columns), STEPS) == wanted


def dataset(root, *columns, seeds=(0, 1)):
    return write_columns(
        root, [{STATE: moving(STEPS, 3, s), ACTION: moving(STEPS, 3, s) + 1, **judged(*columns)} for s in seeds]
    )


def episodes(root):
    demonstrations = Demonstrations(DatasetSettings("local/src", str(root)))
    return demonstrations.episodes(make_agent(demonstrations.meta))


@pytest.mark.parametrize("kind", ["dense and success", "dense, success early", "penalties", "success alone"])
def test_training_sees_demonstrations_up_to_their_success(tmp_path, kind):
    *columns, (last, success) = ENDS[kind]
    for episode in episodes(dataset(tmp_path / "src", *columns)):
        assert len(episode.action) == last + 1
        assert episode.success == episode.terminated == success
        if columns[0] is not None:
            np.testing.assert_allclose(episode.reward, columns[0][: last + 1], atol=1e-6)


def test_a_success_that_is_never_true_says_nothing(tmp_path, caplog):
    found = episodes(dataset(tmp_path / "src", at(25), at(), at(39)))
    assert [len(e.action) for e in found] == [26, 26]
    assert "is never true" in caplog.text


def test_it_is_said_where_most_steps_come_after_the_ends(tmp_path, caplog):
    root = dataset(tmp_path / "src", RISING, None, None)
    assert [len(e.action) for e in episodes(root)] == [1, 1]
    assert "Only 2 of 80 demonstrated steps" in caplog.text
    assert "cqn-data label" in caplog.text
    found = inspect(root)
    assert found["early_end"].level == "warning"
    assert "78 of 80 steps" in found["early_end"].text
    assert "dense_reward" in found
    labelled = run("label", root, tmp_path / "dst", "--all")
    assert labelled.num_frames == 80
    assert [len(e.action) for e in episodes(tmp_path / "dst")] == [40, 40]
    assert not {"early_end", "dense_reward"} & set(inspect(tmp_path / "dst"))


def test_inspect_is_quiet_where_success_is_at_the_end(tmp_path):
    found = inspect(dataset(tmp_path / "src", RISING, at(39), at(39)))
    assert "early_end" not in found
    assert found["dense_reward"].level == "warning"
    found = inspect(dataset(tmp_path / "other", PENALTY, at(39), at(39)))
    assert "no_success" not in found
