"""What the columns of a recording mean: velocities, names of any kind, whole numbers, angles that wrap, depth."""

import json
import logging

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.cli import main
from cqn_data.decisions.angles import full_turn, turned
from cqn_data.decisions.joints import match_joints, rate_dims
from lerobot_cqn.delta_actions import DeltaJoints, description, parse
from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import dimension_names

from .columns import ACTION, JOINTS, STATE, TOP, grey, moving, write_columns
from .data_recording import column, last_line, run
from .test_data_inspect import inspect

BASE = ["shoulder.pos", "elbow.pos", "gripper.pos", "x.vel", "y.vel", "theta.vel"]


def driving(seed):
    """An arm that moves for 40 steps; then a base that drives for 60 at one speed; then 20 steps of rest."""
    state = np.zeros((120, 6), np.float32)
    state[:40, :2] = moving(40, 2, seed)
    state[40:, :2] = state[39, :2]
    state[40:100, 3] = 0.2
    return {STATE: state, ACTION: state.copy()}


@pytest.fixture(scope="module")
def lekiwi(tmp_path_factory):
    names = {STATE: BASE, ACTION: BASE}
    return write_columns(tmp_path_factory.mktemp("base") / "src", [driving(0), driving(1)], names)


def test_driving_at_one_speed_is_no_pause(lekiwi, tmp_path, capsys):
    run("filter", lekiwi, tmp_path / "dst", "--auto")
    assert "Velocities: x.vel, y.vel, theta.vel" in capsys.readouterr().err
    speed, episode = column(tmp_path / "dst", ACTION)[:, 3], column(tmp_path / "dst", "episode_index")
    assert [int((speed[episode == i] > 0.1).sum()) for i in (0, 1)] == [60, 60]
    assert len(speed) < 2 * 110  # the rest at the end is gone
    again = run("filter", tmp_path / "dst", tmp_path / "again", "--auto")
    assert again.num_frames == len(speed)
    trimmed = run("trim", lekiwi, tmp_path / "trimmed", "--motion", "--auto")
    assert 2 * 100 <= trimmed.num_frames <= 2 * 102
    slow = run("filter", lekiwi, tmp_path / "slow", "--auto", '--joint_thresholds={"x.vel": 0.5}')
    assert slow.num_frames < 2 * 60


def test_differences_leave_velocities_alone_and_come_back(lekiwi, tmp_path, capsys):
    run("delta", lekiwi, tmp_path / "dst")
    assert "Left as they are, since their names say that they are no positions: x.vel" in capsys.readouterr().err
    np.testing.assert_array_equal(column(tmp_path / "dst", ACTION)[:, 3:], column(lekiwi, ACTION)[:, 3:])
    assert np.abs(column(tmp_path / "dst", ACTION)[:, :2]).max() < 1e-6
    run("delta", tmp_path / "dst", tmp_path / "back", "--to=absolute")
    np.testing.assert_allclose(column(tmp_path / "back", ACTION), column(lekiwi, ACTION), atol=1e-6)


def test_inspect_counts_driving_as_motion(lekiwi):
    found = inspect(lekiwi)
    assert "x.vel" in found["velocities"].text
    from cqn_data.disk.source import open_source
    from cqn_data.inspection.numbers import measure

    assert all(e.still < 0.25 for e in measure(open_source("x", str(lekiwi))).episodes)


def test_a_base_without_joints_can_be_filtered(tmp_path):
    episode = {key: value[:, 3:] for key, value in driving(0).items()}
    root = write_columns(tmp_path / "src", [episode], {STATE: BASE[3:], ACTION: BASE[3:]})
    inspect(root)
    assert run("filter", root, tmp_path / "dst", "--auto").num_frames in (60, 61)
    run("delta", root, tmp_path / "no", code=2)


@pytest.mark.parametrize(
    ("names", "wanted"),
    [
        ({"delta_x": 0, "delta_y": 1, "delta_z": 2, "gripper": 3}, ["delta_x", "delta_y", "delta_z", "gripper"]),
        ({"gripper": 3, "delta_x": 0, "delta_z": 2, "delta_y": 1}, ["delta_x", "delta_y", "delta_z", "gripper"]),
        ({"motors": JOINTS}, JOINTS),
        ([JOINTS], JOINTS),
        ({"arm": JOINTS[:3], "hand": JOINTS[3:]}, JOINTS),
        (["j", "j", "k", "j"], ["j#0", "j#1", "k", "j#3"]),
        (JOINTS[:2], list("0123")),
        (None, list("0123")),
    ],
    ids=["teleoperator", "unordered", "motors", "nested", "groups", "twice", "few", "none"],
)
def test_names_of_every_kind(names, wanted):
    assert dimension_names({"shape": (4,), "names": names}) == wanted


def test_gripper_of_a_teleoperator_is_found_whatever_way_it_is_named(tmp_path):
    state = np.zeros((80, 6), np.float32)
    state[:40] = moving(40, 6)
    state[40:] = state[39]
    action = np.zeros((80, 4), np.float32)
    action[:39, :3] = np.diff(state[:40, :3], axis=0)
    action[:, 3] = np.repeat([1, 2, 0, 1], [50, 10, 10, 10])
    named = {"delta_x": 0, "delta_y": 1, "delta_z": 2, "gripper": 3}
    kept = []
    for number, names in enumerate((named, list(named))):
        root = write_columns(tmp_path / f"src{number}", [{STATE: state, ACTION: action}], {ACTION: names})
        run("filter", root, tmp_path / f"dst{number}", "--auto")
        kept.append(column(tmp_path / f"dst{number}", "source.frame_index").tolist())
        assert "no_gripper" not in inspect(root)
        run("delta", root, tmp_path / "no", code=2)
    assert kept[0] == kept[1]
    assert {50, 60, 70} <= set(kept[0])


def features(states, actions, sizes=(3, 3)):
    return {STATE: {"shape": sizes[:1], "names": states}, ACTION: {"shape": sizes[1:], "names": actions}}


def test_states_and_actions_are_matched_by_name_or_it_is_said():
    by_name = match_joints(features(["a.pos", "b.pos", "c.pos"], ["c.pos", "a.pos", "b.pos"]))
    assert (by_name.action_dims, by_name.state_dims, by_name.remark()) == ((0, 1, 2), (2, 0, 1), "")
    for states, actions in ((None, None), (None, ["a", "b", "c"]), (["a", "b", "c"], ["x", "y", "z"])):
        by_place = match_joints(features(states, actions))
        assert by_place.state_dims == (0, 1, 2)
        assert "by their place" in by_place.remark()
    for impossible in (
        features(None, None, (4, 3)),  # numbers are no names
        features(["a", "b", "c"], ["b", "a", "d"]),  # names that say otherwise than their place
        features(["a", "b", "c", "d"], ["x", "y", "z"], (4, 3)),
    ):
        with pytest.raises(DataError, match="Cannot tell which state belongs to which action"):
            match_joints(impossible)


def test_a_history_finds_dimensions_of_one_name_again():
    twice = features(["j", "j", "k"], ["j", "j", "k"])
    deltas = DeltaJoints("command", (0, 1, 2), (0, 1, 2))
    assert parse(json.loads(json.dumps(description(deltas, twice))), twice, None) == deltas


def test_delta_says_what_it_took_for_granted(tmp_path, capsys):
    episode = {STATE: moving(20), ACTION: moving(20) + 1}
    root = write_columns(tmp_path / "src", [episode], {STATE: None, ACTION: None})
    run("delta", root, tmp_path / "dst")
    assert "matched by their place" in capsys.readouterr().err
    assert inspect(root)["matching"].level == "note"
    root = write_columns(tmp_path / "other", [{STATE: moving(20, 6), ACTION: moving(20) + 1}], {ACTION: None})
    run("delta", root, tmp_path / "no", code=2)
    assert "correct 'names' in meta/info.json" in last_line(capsys)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "int32", "int64", "float64"])
def test_differences_of_whole_numbers_have_their_sign(tmp_path, dtype):
    state = (100 + 5 * moving(20)).round()
    action = state + np.where(np.arange(20)[:, None] % 2, 9, -7)
    root = write_columns(tmp_path / "src", [{STATE: state.astype(dtype), ACTION: action.astype(dtype)}] * 2)
    dataset = run("delta", root, tmp_path / "dst")
    np.testing.assert_allclose(column(tmp_path / "dst", ACTION)[:20, :3], (action - state)[:, :3])
    np.testing.assert_allclose(dataset.meta.stats[ACTION]["min"][:3], -7)
    run("filter", tmp_path / "dst", tmp_path / "filtered", "--threshold=1")
    run("delta", tmp_path / "filtered", tmp_path / "back", "--to=absolute")
    kept = column(tmp_path / "back", "source.frame_index")
    np.testing.assert_allclose(column(tmp_path / "back", ACTION)[: len(kept) // 2], action[kept[: len(kept) // 2]])
    assert column(root, ACTION).dtype == np.dtype(dtype)


def test_whole_numbers_that_would_not_hold_a_difference_are_refused(tmp_path, capsys):
    action = np.full((20, 4), 3, np.uint8)
    state = np.cumsum(np.full((20, 4), -3), axis=0).astype(np.float32)
    root = write_columns(tmp_path / "src", [{STATE: state, ACTION: action}])
    run("resample", root, tmp_path / "dst", "--fps=5", "--actions=state", code=2)
    assert "does not fit into uint8" in last_line(capsys)


@pytest.mark.parametrize(("turn", "low"), [(2 * np.pi, -np.pi), (360, -180), (360, 0)], ids=["rad", "deg", "compass"])
def test_angles_that_wrap_are_named_and_never_become_a_difference(tmp_path, capsys, turn, low):
    angle = np.linspace(0, 1.9 * turn, 60)
    state, action = moving(60) / 100, moving(60) / 100
    state[:, 1] = (angle - low) % turn + low
    action[:, 1] = (angle + 0.02 * turn - low) % turn + low
    root = write_columns(tmp_path / "src", [{STATE: state, ACTION: action}])
    for kind in ("command", "command_steps", "state"):
        run("delta", root, tmp_path / "no", f"--of={kind}", code=2)
        said = last_line(capsys)
        assert "'lift.pos'" in said
    wanted = said.split("--keep_absolute='")[1].split("'")[0]
    assert json.loads(wanted) == ["lift.pos", "gripper.pos"]
    run("delta", root, tmp_path / "dst", f"--keep_absolute={wanted}")
    np.testing.assert_array_equal(column(tmp_path / "dst", ACTION)[:, 1], action[:, 1])
    assert "'lift.pos'" in inspect(root)["wraps"].text


def test_turns_are_seen_in_angles_only():
    low, high = np.array([-np.pi, -180, 0, -100, -1]), np.array([np.pi, 180, 360, 100, 1])
    turns = full_turn(low, high)
    np.testing.assert_allclose(turns, [2 * np.pi, 360, 360, np.inf, np.inf])
    assert turned(np.array([[6.2, 350, -350, 199, 2], [1, 90, 90, 0, 0]]), turns).tolist() == [
        [True, True, True, False, False],
        [False] * 5,
    ]


def test_velocities_are_known_by_their_names():
    assert rate_dims(["x.vel", "base_velocity_z", "speed", "elbow.pos", "level", "marvel.pos"]) == (0, 1, 2)


def test_one_dimension_is_enough(tmp_path):
    from cqn_train.config import DatasetSettings
    from cqn_train.replay.demonstrations import Demonstrations, _column

    episode = {STATE: moving(20, 1), ACTION: moving(20, 1) + 1}
    root = write_columns(tmp_path / "src", [episode], {STATE: ["slide.pos"], ACTION: ["slide.pos"]})
    for number, operation in enumerate((["delta"], ["trim", "--head=2"], ["bounds"], ["resample", "--fps=5"])):
        run(operation[0], root, tmp_path / str(number), *operation[1:])
    np.testing.assert_allclose(column(tmp_path / "0", ACTION), 1, atol=1e-5)
    dataset = Demonstrations(DatasetSettings(repo_id="local/src", root=str(root))).dataset
    assert _column(dataset.hf_dataset.with_format("numpy"), ACTION).shape == (20, 1)


def test_a_policy_does_not_look_at_depth(tmp_path, caplog):
    from lerobot.policies.factory import make_policy, make_pre_post_processors

    from lerobot_cqn.configuration_cqn import CQNConfig

    depth = np.broadcast_to(np.arange(500, 512, dtype=np.uint16)[:, None, None, None], (12, 48, 48, 1))
    episode = {STATE: moving(12), ACTION: moving(12), TOP: grey(12), "observation.images.depth": depth}
    root = write_columns(tmp_path / "src", [episode])
    meta = LeRobotDataset("local/src", root).meta
    assert meta.depth_keys == ["observation.images.depth"]
    config = CQNConfig(device="cpu", preset="laptop_pixels", push_to_hub=False)
    with caplog.at_level(logging.WARNING):
        policy = make_policy(config, ds_meta=meta)
    assert policy.view_keys == (TOP,)
    assert "observation.images.depth is left out" in caplog.text
    make_pre_post_processors(config, dataset_stats=meta.stats)
    policy.save_pretrained(tmp_path / "policy")
    assert "depth" not in (tmp_path / "policy/config.json").read_text()


def test_commands_that_the_arm_does_not_follow_are_said(tmp_path):
    state = [moving(60, seed=s) for s in range(3)]
    follows = [{STATE: s, ACTION: np.concatenate([s[1:], s[-1:]])} for s in state]
    assert not {"far_commands", "gripper_chatter"} & set(inspect(write_columns(tmp_path / "good", follows)))
    noise = np.random.default_rng(0)
    shaken = [{**e, ACTION: (e[ACTION] + noise.normal(0, 6, e[ACTION].shape)).astype(np.float32)} for e in follows]
    assert inspect(write_columns(tmp_path / "noise", shaken))["far_commands"].level == "warning"
    cut = [{**e, ACTION: np.concatenate([e[ACTION][:, :2].clip(-1, 1), e[ACTION][:, 2:]], 1)} for e in follows]
    assert "pan.pos" in inspect(write_columns(tmp_path / "cut", cut))["far_commands"].text


def test_a_leap_to_the_leader_is_said_and_cut_and_widens_no_bounds(tmp_path):
    def episode(seed, leap):
        state = moving(60, seed=seed)
        command = np.concatenate([state[1:], state[-1:]])
        state[:leap] += np.float32([0, 80, 0, 0])
        return {STATE: state, ACTION: command}

    options = ["--repo_id=local/src", "--filter.auto=false", "--filter.threshold=0.001"]
    widths = {}
    for name, leap in {"leap": 5, "none": 0}.items():
        root = write_columns(tmp_path / name, [episode(s, leap if s == 1 else 0) for s in range(4)])
        assert ("leaps" in inspect(root)) == bool(leap)
        trimmed = tmp_path / f"{name}_trimmed"
        assert main(["trim", "--leap", options[0], f"--root={root}", f"--new_root={trimmed}"]) == 0
        assert main(["run", "arm_state", *options, f"--root={trimmed}", f"--new_root={tmp_path / name}_clean"]) == 0
        actions = column(tmp_path / f"{name}_clean", ACTION)[:, :3]
        widths[name] = np.ptp(actions, axis=0)
    np.testing.assert_allclose(widths["leap"], widths["none"], rtol=0.2)
    found = inspect(tmp_path / "leap")["leaps"]
    assert "episode 1" in found.where
    assert "for 5 of its steps" in found.text
    assert (
        main(["trim", *options[:1], f"--root={tmp_path / 'leap_clean'}", f"--new_root={tmp_path / 'x'}", "--leap"]) == 2
    )


def test_a_gripper_that_flickers_is_said(tmp_path):
    def episode(seed):
        state = moving(60, seed=seed)
        command = np.concatenate([state[1:], state[-1:]])
        command[:, 3] = 10 * (np.arange(60) % 2)
        return {STATE: state, ACTION: command}

    found = inspect(write_columns(tmp_path / "src", [episode(s) for s in range(3)]))["gripper_chatter"]
    assert found.level == "warning"
    assert "episodes 0, 1, 2" in found.where
