"""From joint differences to goals: the maths against what the dataset tools write, and the steps around a policy."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep
from lerobot.processor.relative_action_processor import RelativeActionsProcessorStep

from cqn_data.decisions.deltas import to_absolute, to_delta
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.configuration_drqv2 import DrQv2Config
from lerobot_cqn.delta_actions import KINDS, DeltaJoints
from lerobot_cqn.errors import DataError
from lerobot_cqn.joint_goals import (
    DeltaToGoalProcessorStep,
    GoalToDeltaProcessorStep,
    RememberJointsProcessorStep,
    action_of,
    converted_deltas,
    goal_of,
    undone_deltas,
)
from lerobot_cqn.schema import HISTORY

D, J, P, T = 4, 3, 5, 12
ACTION_DIMS, STATE_DIMS = (0, 1, 3), (0, 2, 4)  # the gripper in between stays absolute
ACTION_NAMES = ["pan.pos", "lift.pos", "gripper.pos", "wrist.pos"]
STATE_NAMES = ["pan.pos", "button.pos", "lift.pos", "gripper.pos", "wrist.pos"]
kinds = pytest.mark.parametrize("kind", KINDS)


def deltas(kind: Any) -> DeltaJoints | None:
    return None if kind is None else DeltaJoints(kind, ACTION_DIMS, STATE_DIMS)


def numbers(*shape: int) -> Any:
    return arrays(np.float64, shape, elements=st.floats(-200, 200)).map(torch.from_numpy)


# -- the maths ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [None, *KINDS])
@given(goal=numbers(2, D), last=numbers(2, D), state=numbers(2, P))
def test_there_and_back(kind: Any, goal: Any, last: Any, state: Any) -> None:
    copies = [value.clone() for value in (goal, last, state)]
    action = action_of(goal, state, last, deltas(kind))
    torch.testing.assert_close(goal_of(action, state, last, deltas(kind)), goal, rtol=0, atol=1e-9)
    torch.testing.assert_close(
        action_of(goal_of(goal, state, last, deltas(kind)), state, last, deltas(kind)), goal, rtol=0, atol=1e-9
    )
    assert torch.equal(action[:, 2], goal[:, 2])
    assert kind is not None or torch.equal(action, goal)
    assert all(torch.equal(a, b) for a, b in zip(copies, (goal, last, state), strict=True))


def test_goals_are_float32_at_least() -> None:
    goal = goal_of(
        torch.ones(1, D, dtype=torch.bfloat16), torch.full((1, P), 100.1), torch.zeros(1, D), deltas("state")
    )
    assert goal.dtype == torch.float32
    assert goal[0, 0] == pytest.approx(101.1)


def test_wrong_descriptions_are_refused() -> None:
    with pytest.raises(DataError, match="Did you mean 'command'"):
        DeltaJoints("comand", (0,), (0,))  # type: ignore[arg-type]
    with pytest.raises(DataError, match="found 2 action and 1 state"):
        DeltaJoints("state", (0, 1), (0,))


def episodes(seed: int, count: int) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """States [K, T, P] and absolute actions [K, T, D] of K episodes."""
    rng = np.random.default_rng(seed)
    state = np.cumsum(rng.normal(0, 2, (count, T, P)), axis=1) + rng.uniform(-90, 90, (count, 1, P))
    goals = state[..., STATE_DIMS] + rng.normal(0, 3, (count, T, J))
    return state, np.insert(goals, 2, rng.uniform(0, 100, (count, T)), axis=2)


def as_deltas(state: Any, goals: Any, kind: Any) -> tuple[Any, Any]:
    """The episodes' actions as `cqn-data delta` writes them, and where `to_absolute` says that they lead."""
    written, led = goals.copy(), goals.copy()
    for k in range(len(goals)):
        written[k][:, ACTION_DIMS] = to_delta(goals[k][:, ACTION_DIMS], state[k][:, STATE_DIMS], kind)
        led[k][:, ACTION_DIMS] = to_absolute(written[k][:, ACTION_DIMS], state[k][:, STATE_DIMS], kind)
    return written, led


@kinds
@given(seed=st.integers(0, 10**6))
def test_a_recording_is_driven_as_the_tools_say(kind: Any, seed: int) -> None:
    """Over whole episodes, three at a time, through the steps; with a reset in between."""
    remember = RememberJointsProcessorStep()
    to_goal = DeltaToGoalProcessorStep(kind, ACTION_DIMS, STATE_DIMS, remember)
    for number in range(2):
        state, goals = episodes(seed + number, 3)
        written, led = (torch.from_numpy(v) for v in as_deltas(state, goals, kind))
        remember.reset()
        to_goal.reset()
        for t in range(T):
            remember({"observation": {"observation.state": torch.from_numpy(state[:, t])}})  # type: ignore[typeddict-item]
            for _ in range(2):  # asked twice in a step, the answer is the same
                goal = to_goal({"action": written[:, t]})["action"]  # type: ignore[typeddict-item]
                torch.testing.assert_close(goal, led[:, t], rtol=0, atol=1e-9)
            torch.testing.assert_close(to_goal.action_of(goal), written[:, t], rtol=0, atol=1e-9)


def test_a_sequence_of_differences_is_not_driven_from_one_frame() -> None:
    remember = RememberJointsProcessorStep()
    to_goal = DeltaToGoalProcessorStep("command", ACTION_DIMS, STATE_DIMS, remember)
    seen: Any = {"observation": {"observation.state": torch.zeros(1, P)}}
    remember(seen)
    sequence = torch.randn(1, 3, D)
    with pytest.raises(DataError, match="step by step"):
        to_goal({"action": sequence})  # type: ignore[typeddict-item]
    to_goal({"action": sequence[:, 0]})  # type: ignore[typeddict-item]
    with pytest.raises(DataError, match="cannot be driven from one frame"):  # as LeRobot's policy server asks
        to_goal({"action": sequence[:, 1]})  # type: ignore[typeddict-item]
    remember(seen)
    to_goal({"action": sequence[:, 1]})  # type: ignore[typeddict-item]


# -- the pipelines -----------------------------------------------------------------------------------------------------


def history(root: Path, *entries: dict[str, Any]) -> SimpleNamespace:
    """LeRobot's metadata of a dataset with these operations, as far as it is read."""
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / HISTORY).write_text(json.dumps({"version": 1, "operations": entries}))
    features = {
        "action": {"shape": (D,), "names": ACTION_NAMES},
        "observation.state": {"shape": (P,), "names": {"motors": STATE_NAMES}},
    }
    return SimpleNamespace(root=root, features=features, stats=None)


def entry(operation: str, kind: str | None) -> dict[str, Any]:
    joints = [n for n in ACTION_NAMES if "gripper" not in n]
    made = None if kind is None else {"kind": kind, "action": joints, "state": joints}
    return {"operation": operation, "deltas": made}


OTHER = {"operation": "label", "settings": {}}


@pytest.mark.parametrize(("entries", "kind"), [
    ([], None),
    ([OTHER], None),
    ([entry("delta", "command"), OTHER], "command"),
    ([OTHER, entry("delta", "command_steps"), entry("delta", None)], None),
    ([entry("delta", "command"), entry("delta", None), OTHER, entry("delta", "state")], "state"),
    ([entry("record", "command"), OTHER], None),
    # The environment takes differences: undone and done again they are still what it takes.
    ([entry("record", "command"), entry("delta", None), entry("delta", "command")], None),
])  # fmt: skip
def test_what_the_history_says(entries: list[dict[str, Any]], kind: str | None, tmp_path: Path) -> None:
    assert converted_deltas(history(tmp_path, *entries)) == deltas(kind)


@pytest.mark.parametrize(("entries", "kind"), [
    ([], None),
    ([entry("delta", "command"), entry("delta", None)], None),
    ([entry("record", "command_steps"), OTHER], None),
    ([entry("record", "command_steps"), entry("delta", None), OTHER], "command_steps"),
    ([entry("record", "command"), entry("delta", None), entry("delta", "command")], None),
])  # fmt: skip
def test_differences_that_were_undone_are_what_the_environment_takes(
    entries: list[dict[str, Any]], kind: str | None, tmp_path: Path
) -> None:
    assert undone_deltas(history(tmp_path, *entries)) == deltas(kind)


def test_differences_of_another_kind_than_recorded_are_refused(tmp_path: Path) -> None:
    meta = history(tmp_path, entry("record", "command_steps"), entry("delta", None), entry("delta", "command"))
    with pytest.raises(DataError, match="takes differences of kind 'command_steps', the dataset now has 'command'"):
        undone_deltas(meta)


@kinds
@given(seed=st.integers(0, 10**6))
def test_goals_become_the_differences_that_were_recorded(kind: Any, seed: int) -> None:
    """Over whole episodes: what `cqn-data delta --to=absolute` made of a recording is driven as it was recorded."""
    remember = RememberJointsProcessorStep()
    to_delta = GoalToDeltaProcessorStep(kind, ACTION_DIMS, STATE_DIMS, remember)
    for number in range(2):
        state, goals = episodes(seed + number, 3)
        written, led = (torch.from_numpy(v) for v in as_deltas(state, goals, kind))
        remember.reset()
        to_delta.reset()
        for t in range(T):
            remember({"observation": {"observation.state": torch.from_numpy(state[:, t])}})  # type: ignore[typeddict-item]
            for _ in range(2):  # asked twice in a step, the answer is the same
                action = to_delta({"action": led[:, t]})["action"]  # type: ignore[typeddict-item]
                torch.testing.assert_close(action, written[:, t], rtol=0, atol=1e-9)


def test_without_history_or_dataset_nothing_is_converted(tmp_path: Path) -> None:
    assert converted_deltas(None) is None
    assert converted_deltas(SimpleNamespace(root=tmp_path, features={})) is None


@pytest.mark.parametrize("damage", [
    {"deltas": {"kind": "command", "action": ["elbow.pos"], "state": ["elbow.pos"]}},
    {"deltas": {"kind": "sideways", "action": [], "state": []}}, {"deltas": {"kind": "command"}}, {"deltas": "command"},
])  # fmt: skip
def test_a_history_that_does_not_fit_is_one_line(damage: dict[str, Any], tmp_path: Path) -> None:
    meta = history(tmp_path, {"operation": "delta", **damage})
    with pytest.raises(DataError, match=r"does not fit|Unknown kind") as raised:
        converted_deltas(meta)
    assert "\n" not in str(raised.value)
    (tmp_path / HISTORY).write_text("{}")
    with pytest.raises(DataError, match="is damaged"):
        converted_deltas(meta)


def config(policy: type[Any] = CQNConfig) -> Any:
    return policy(
        preset="laptop_state", device="cpu",
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (P,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (D,))},
    )  # fmt: skip


STATS = {
    "observation.state": {"min": np.full(P, -180.0), "max": np.full(P, 180.0)},
    "action": {"min": np.full(D, -4.0), "max": np.full(D, 4.0)},
}


def pipelines(root: Path, kind: Any, policy: type[Any] = CQNConfig, where: str = "given") -> tuple[Any, Any]:
    meta, made = history(root, entry("delta", kind)), config(policy)
    if where == "in the config":  # as lerobot-train does
        made._runtime_dataset_meta = meta
        return make_pre_post_processors(made, dataset_stats=STATS)
    if where == "saved":
        for pipeline in make_pre_post_processors(made, dataset_stats=STATS, dataset_meta=meta):
            pipeline.save_pretrained(root / "saved")
        return make_pre_post_processors(made, pretrained_path=str(root / "saved"))
    return make_pre_post_processors(made, dataset_stats=STATS, dataset_meta=meta)


@kinds
@pytest.mark.parametrize("policy", [CQNConfig, DrQv2Config])
@pytest.mark.parametrize("where", ["given", "in the config", "saved"])
def test_the_pipelines_lead_an_arm_as_the_recording(kind: Any, policy: Any, where: str, tmp_path: Path) -> None:
    pre, post = pipelines(tmp_path, kind, policy, where)
    # Rollout refuses steps that say they are enabled.
    assert [s.enabled for s in pre.steps if isinstance(s, RelativeActionsProcessorStep)] == [False]
    state, goals = episodes(7, 2)
    written, led = as_deltas(state, goals, kind)
    written[..., 2] /= 50.0
    led[..., 2] /= 50.0
    for _ in range(2):
        pre.reset()
        post.reset()
        for t in range(T):
            seen = pre({"observation.state": torch.from_numpy(state[:, t]).float()})["observation.state"]
            assert seen.abs().max() <= 2
            goal = post(torch.from_numpy(written[:, t] / 4.0).float())
            torch.testing.assert_close(goal, torch.from_numpy(led[:, t]).float(), rtol=0, atol=1e-3)


def test_a_single_frame_has_a_batch_of_one(tmp_path: Path) -> None:
    pre, post = pipelines(tmp_path, "command")
    pre({"observation.state": torch.tensor([10.0, 20, 30, 40, 50])})
    assert post(torch.zeros(1, D)).tolist() == [[10.0, 30.0, 0.0, 50.0]]


def test_where_the_robot_takes_actions_as_they_are_nothing_is_added(tmp_path: Path) -> None:
    for entries in ([], [entry("record", "command")]):
        pair = make_pre_post_processors(config(), dataset_stats=STATS, dataset_meta=history(tmp_path, *entries))
        assert not [s for p in pair for s in p.steps if isinstance(s, RememberJointsProcessorStep)]
        assert not [s for p in pair for s in p.steps if isinstance(s, DeltaToGoalProcessorStep)]
        assert pair[1](torch.full((1, D), 0.5)).tolist() == [[2.0] * D]


@pytest.mark.parametrize("where", ["given", "saved"])
def test_without_joints_there_is_no_goal(where: str, tmp_path: Path) -> None:
    pre, post = pipelines(tmp_path, "command", where=where)
    (to_goal,) = (s for s in post.steps if isinstance(s, DeltaToGoalProcessorStep))
    for ask in (lambda: post(torch.zeros(1, D)), lambda: to_goal.action_of(torch.zeros(1, D))):
        with pytest.raises(DataError, match=r"no joints were seen yet: expected 'observation\.state'"):
            ask()
    pre({"observation.state": torch.zeros(1, P)})
    post(torch.zeros(1, D))
    pre.reset()
    post.reset()
    with pytest.raises(DataError, match="no joints were seen yet"):
        post(torch.zeros(1, D))


def drive(kind: Any, tmp_path: Path) -> tuple[Any, Any, DeltaToGoalProcessorStep]:
    pre, post = pipelines(tmp_path, kind)
    (to_goal,) = (s for s in post.steps if isinstance(s, DeltaToGoalProcessorStep))
    return lambda at: pre({"observation.state": torch.full((1, P), at)}), post, to_goal


def test_what_was_sent_is_the_last_goal(tmp_path: Path) -> None:
    see, post, to_goal = drive("command_steps", tmp_path)
    see(10.0)
    assert post(torch.full((1, D), 0.5))[0, 0] == 12  # from the joints
    limited = torch.full((1, D), 11.0)
    assert to_goal.action_of(limited)[0, 0] == 1
    to_goal.sent(limited)
    assert to_goal.action_of(limited)[0, 0] == 1  # also after it was sent
    see(10.5)
    assert post(torch.full((1, D), 0.5))[0, 0] == 13
    see(11.0)  # the person drives: the policy is not asked
    theirs = torch.full((1, D), 20.0)
    assert to_goal.action_of(theirs)[0, 0] == 7
    to_goal.sent(theirs)
    theirs.zero_()  # the caller's own
    see(12.0)
    assert post(torch.zeros(1, D))[0, 0] == 20
    to_goal.sent(None)  # a pause: the arm may be anywhere
    see(5.0)
    assert post(torch.zeros(1, D))[0, 0] == 5


def test_what_was_sent_does_not_matter_where_joints_are_the_base(tmp_path: Path) -> None:
    see, post, to_goal = drive("command", tmp_path)
    see(10.0)
    post(torch.zeros(1, D))
    to_goal.sent(torch.full((1, D), 99.0))
    see(11.0)
    assert post(torch.zeros(1, D))[0, 0] == 11


def test_the_state_is_remembered_as_it_was(tmp_path: Path) -> None:
    """An environment may write its next state into the same memory."""
    pre, post = pipelines(tmp_path, "state")
    state = torch.full((1, P), 50.0)
    assert pre({"observation.state": state})["observation.state"][0, 0] == pytest.approx(50 / 180)
    state.zero_()
    assert post(torch.zeros(1, D))[0, 0] == 50


def test_training_batches_pass(tmp_path: Path) -> None:
    pre, _ = pipelines(tmp_path, "command")
    batch = pre({"observation.state": torch.full((8, 2, P), 90.0), "action": torch.full((8, 1, D), 2.0)})
    assert batch["action"].eq(0.5).all()
    assert batch["observation.state"].eq(0.5).all()
    assert any(isinstance(step, NormalizerProcessorStep) for step in pre.steps)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu(tmp_path: Path) -> None:
    pre, post = pipelines(tmp_path, "command_steps")
    for state, action in (("cpu", "cuda"), ("cuda", "cuda"), ("cuda", "cpu")):
        post.reset()
        pre({"observation.state": torch.full((1, P), 10.0, device=state)})
        goal = post(torch.full((1, D), 0.5, device=action))
        assert goal.device.type == "cpu"
        assert goal[0, 0] == 12
