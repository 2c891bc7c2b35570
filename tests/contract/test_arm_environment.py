"""Episodes on the simulated arm with a scripted person: what the loop is told, and what the arm does meanwhile."""

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from cqn_train.clock import REAL
from cqn_train.interfaces import Interrupted, Label
from cqn_train.operator.session import Event, State

from .arm_bench import FPS, HOME_DEG, STEP_DEG, Bench, bench

pytest.importorskip("mujoco")
LABELS = {Event.SUCCESS: Label.SUCCESS, Event.FAILURE: Label.FAILURE, Event.DISCARD: Label.DISCARD}


@pytest.fixture
def arm() -> Iterator[Bench]:
    with bench() as made:
        yield made


def test_whole_episodes(arm: Bench) -> None:
    assert (arm.env.max_steps, arm.env.fps) == (60 * FPS, FPS)
    for number, label in enumerate((Event.SUCCESS, Event.FAILURE, Event.DISCARD)):
        frame = arm.begin()
        assert frame["observation.state"].shape == (1, 10)
        assert arm.session.episode == number
        for step in range(1, 8):
            outcome = arm.step(2.0 * step)
            assert (outcome.ended, outcome.skipped, outcome.taught, outcome.reward) == (False, False, False, 0.0)
            assert outcome.sent is not None
            assert np.array_equal(outcome.sent[0].numpy(), arm.goals[-1])
        arm.do(label)
        outcome = arm.step(16)
        assert outcome.ended
        assert outcome.reward == outcome.success == (label is Event.SUCCESS)
        assert outcome.terminated == (label is not Event.DISCARD)  # a failure that a person sees is an end
        assert outcome.discarded == (label is Event.DISCARD)
        assert outcome.terminated != outcome.truncated
        # The step into which the label came either happened or did not: both are said.
        assert arm.display.ended[-1] == (number, 7 if outcome.skipped else 8)
        assert arm.session.busy  # until the loop asks for the next one
    assert arm.display.begun == [0, 1, 2]
    arm.check()


@pytest.mark.parametrize("label", LABELS)
@pytest.mark.parametrize("moment", ["before the first step", "in a step", "paused", "teaching", "time is up"])
def test_a_label_ends_the_episode_at_any_moment(label: Event, moment: str) -> None:
    with bench(episode_s=5 / FPS if moment == "time is up" else 60) as arm:
        arm.begin()
        if moment == "before the first step":
            arm.do(label)
            outcome, steps = arm.step(5), 0
        elif moment == "in a step":
            arm.step(2)
            arm.meanwhile(lambda: (arm.clock.sleep(0.4 / FPS), arm.do(label)))
            outcome, steps = arm.step(4), 2
        elif moment == "paused":
            arm.step(2)
            arm.do(Event.PAUSE)
            arm.meanwhile(lambda: (arm.clock.sleep(0.05), arm.do(label)))
            outcome, steps = arm.step(4), 1
        elif moment == "teaching":
            arm.do(Event.TAKE_OVER)
            assert arm.step().taught
            arm.do(label)
            outcome, steps = arm.step(), 1
        else:
            arm.meanwhile(lambda: (arm.soon(arm.is_state(State.LABELLING)), arm.clock.sleep(0.05), arm.do(label)))
            for step in range(4):
                assert not arm.step(step).ended
            outcome, steps = arm.step(5), 5
        assert outcome.ended
        assert outcome.reward == outcome.success == (label is Event.SUCCESS)
        assert outcome.discarded == (label is Event.DISCARD)
        # Out of time, "failure" means: not yet; at any other moment it is an end.
        ends = label is Event.SUCCESS or (label is Event.FAILURE and moment != "time is up")
        assert (outcome.terminated, outcome.truncated) == (ends, not ends)
        assert outcome.skipped == (moment in ("before the first step", "paused", "teaching"))
        assert arm.display.ended == [(0, steps)]
        assert arm.session.labels == {0: LABELS[label]}


def test_time_up_holds_the_arm_and_the_wait_is_a_persons(arm: Bench) -> None:
    arm.env.arm.settings.episode_s = 4 / FPS
    arm.begin()
    seen: list[Any] = []

    def label() -> None:
        arm.soon(arm.is_state(State.LABELLING))
        arm.clock.sleep(0.05)
        sent = len(arm.goals)
        seen.append(arm.at_rest())
        seen.append(len(arm.goals) - sent)
        arm.do(Event.FAILURE)

    arm.meanwhile(label)
    before = arm.env.waited_s
    for step in range(4):
        outcome = arm.step(10.0 * step)
    assert outcome.truncated
    assert seen == [True, 0]
    assert arm.env.waited_s - before > 0.15
    arm.check()


def test_time_is_up_also_for_an_episode_that_is_paused_at_that_moment(
    arm: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pause comes between the last step and its end: resumed, the episode waits for its label, not for ever."""
    arm.env.arm.settings.episode_s = 3 / FPS
    arm.begin()
    end = arm.env._time_up
    monkeypatch.setattr(arm.env, "_time_up", lambda: (arm.do(Event.PAUSE), end()))

    def resume() -> None:
        arm.soon(arm.is_state(State.PAUSED))
        arm.clock.sleep(0.05)
        arm.do(Event.RESUME)
        arm.soon(arm.is_state(State.LABELLING))
        arm.do(Event.SUCCESS)

    arm.meanwhile(resume)
    outcomes = [arm.step(1) for _ in range(3)]
    assert [o.ended for o in outcomes] == [False, False, True]
    assert outcomes[-1].success


def test_a_pause_holds_the_arm_and_counts_for_nothing(arm: Bench) -> None:
    arm.begin()
    for step in range(6):
        outcome = arm.step(2.0 * (step + 1))
    before, waited = arm.joints, arm.env.waited_s
    held: dict[str, Any] = {}

    def pause() -> None:
        arm.clock.sleep(0.5 / FPS)
        arm.do(Event.PAUSE)
        began, sent = arm.clock.now, len(arm.goals)
        arm.clock.sleep(0.1)  # enough to stand still, and less than the watchdog's time
        held["soon"] = len(arm.goals) - sent
        held["rests"] = arm.at_rest()
        held["joints"], held["goals"] = arm.joints, arm.goals[sent:]
        arm.do(Event.RESUME)
        held["seconds"] = arm.clock.now - began

    arm.meanwhile(pause)
    outcome = arm.step(20)
    assert held["rests"]
    assert held["soon"] == 1
    assert np.abs(held["joints"] - before).max() <= 2 * STEP_DEG  # the step that was under way, and its hold
    assert len(held["goals"]) == 1  # the hold, and nothing else
    assert outcome.skipped
    assert not outcome.ended
    assert outcome.sent is None
    # The frame is read when things go on.
    assert outcome.frame["observation.state"][0, :6].numpy() == pytest.approx(held["joints"], abs=0.2)
    assert arm.env.waited_s - waited == pytest.approx(held["seconds"], abs=0.06)
    assert arm.env._steps == 6
    assert not arm.step(20).skipped
    assert arm.env._steps == 7
    arm.check()


def test_a_pause_that_is_over_within_a_step_is_one_all_the_same(arm: Bench) -> None:
    arm.begin()
    arm.step(2)
    arm.meanwhile(lambda: (arm.clock.sleep(0.4 / FPS), arm.do(Event.PAUSE, Event.RESUME)))
    assert arm.step(4).skipped
    assert arm.env._steps == 1
    assert not arm.step(6).skipped


def test_a_person_takes_over_and_hands_back_without_a_leap(arm: Bench) -> None:
    """The leader lies far from the arm; what the person does is what is recorded, and goals go on evenly."""
    arm.begin()
    arm.leader.pose = lambda: np.zeros(7)  # nowhere near
    for step in range(5):
        arm.step(2.0 * (step + 1))
    arm.do(Event.TAKE_OVER)
    taken, began = len(arm.goals), arm.goals[-1]
    for step in range(8):
        moved = np.array([0, -1.0 * step, 0.5 * step, 0, 0, 0, 3.0 * step])
        arm.leader.pose = lambda moved=moved: moved
        outcome = arm.step(-20, 20, 20)  # what the policy wants does not matter
        assert outcome.taught
        assert outcome.sent is not None
        np.testing.assert_allclose(outcome.sent[0], arm.goals[-1], atol=1e-9)
    arm.do(Event.HAND_BACK)
    for _ in range(3):
        assert not arm.step(10, -7, 3.5).taught
    taught = np.array(arm.goals[taken : taken + 8])
    assert np.abs(np.diff([began, *taught], axis=0)[:, :6]).max() <= STEP_DEG + 1e-9
    # Its movement is the leader's, counted from where the arm was.
    np.testing.assert_allclose(np.diff(taught, axis=0)[1:, 1], -1.0, atol=0.3)
    assert np.abs(taught[:, 0] - taught[0, 0]).max() < 0.2
    assert taught[:, 6] == pytest.approx(3.0 * np.arange(8))  # the gripper is as it is held
    assert np.abs(np.diff(arm.goals[taken - 1 :], axis=0)[:, :6]).max() <= STEP_DEG + 1e-9
    arm.check()


MOMENTS = ["waiting", "running", "in a step", "paused", "teaching", "labelling", "going home"]


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_stop_comes_through_at_any_moment(moment: str) -> None:
    with bench(episode_s=6 / FPS if moment == "labelling" else 60) as arm:
        arm.env.session.learning("")

        def drive() -> None:
            if moment == "waiting":
                arm.meanwhile(lambda: (arm.clock.sleep(0.05), arm.do(Event.STOP)))
                arm.env.reset(0)
            arm.begin()
            for step in range(5):
                arm.step(3.0 * step, -2.0 * step)
            if moment in ("paused", "teaching"):
                arm.do(Event.PAUSE if moment == "paused" else Event.TAKE_OVER)
            if moment == "going home":
                arm.do(Event.SUCCESS)
                arm.step(18)
                arm.meanwhile(lambda: (arm.clock.sleep(0.1), arm.do(Event.STOP)))
                arm.env.reset(0)
            if moment in ("running", "teaching"):
                arm.do(Event.STOP)
            else:
                arm.meanwhile(lambda: (arm.clock.sleep(0.3 / FPS), arm.do(Event.STOP)))
            for _ in range(3):  # a goal that is under way is the last one
                arm.step(20, 20)

        with pytest.raises(Interrupted):
            drive()
        assert arm.session.state is State.STOPPED
        arm.clock.sleep(0.15)
        held, place = arm.goals[-1].copy() if arm.goals else None, arm.joints
        assert arm.at_rest(0.25)
        assert np.abs(arm.joints - place).max() < 0.1
        # Nothing but the same hold again.
        assert held is None or np.array_equal(arm.goals[-1], held)
        arm.check()


def test_a_stop_does_not_wait_for_a_reading_that_hangs(arm: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    arm.begin()
    for step in range(4):
        arm.step(3.0 * step)
    read, hangs, go_on = arm.robot.get_observation, threading.Event(), threading.Event()

    def hang() -> Any:
        hangs.set()
        arm.clock.wait(go_on, 5)
        return read()

    monkeypatch.setattr(arm.robot, "get_observation", hang)
    said = list[float]()

    def stop() -> None:
        arm.clock.wait(hangs, 5)
        began, sent = arm.clock.now, len(arm.goals)
        arm.do(Event.STOP)
        said.append(arm.clock.now - began)
        arm.clock.sleep(0.1)
        said.append(len(arm.goals) - sent)
        go_on.set()

    arm.meanwhile(stop)

    def drive() -> None:
        for step in range(4, 20):
            arm.step(3.0 * step)

    with pytest.raises(Interrupted):
        drive()
    assert said[0] < 0.05
    assert said[1] == 0
    arm.soon(arm.at_rest)
    held = len(arm.goals)
    arm.clock.sleep(0.25)
    assert len({tuple(goal) for goal in arm.goals[held - 1 :]}) == 1  # the same hold again
    arm.check()


@pytest.mark.real_time(reason="attendant, watchdog and person are threads that nobody puts in order, as on a real arm")
def test_an_episode_a_pause_and_a_stop_with_threads_that_nobody_drives() -> None:
    with bench(clock=REAL) as arm:
        arm.begin()
        for step in range(5):
            assert not arm.step(2.0 * (step + 1)).ended
        arm.meanwhile(lambda: (REAL.sleep(0.4 / FPS), arm.do(Event.PAUSE), REAL.sleep(0.05), arm.do(Event.RESUME)))
        assert any(arm.step(12).skipped for _ in range(400))  # whenever the other thread gets its turn
        arm.do(Event.SUCCESS)
        assert arm.step(14).success
        arm.soon(lambda: np.abs(arm.joints - HOME_DEG[:6]).max() < 0.5)
        arm.begin()
        arm.step(2)
        arm.do(Event.STOP)
        with pytest.raises(Interrupted):
            arm.step(20)
        arm.soon(arm.at_rest)
        held = len(arm.goals)
        REAL.sleep(0.25)
        assert len({tuple(goal) for goal in arm.goals[held - 1 :]}) == 1
        arm.check()


def test_ctrl_c_interrupts_a_wait() -> None:
    asked: list[bool] = []
    with bench(should_stop=lambda: bool(asked)) as arm:
        arm.begin()
        arm.step(5)
        arm.do(Event.PAUSE)
        arm.meanwhile(lambda: (arm.clock.sleep(0.05), asked.append(True)))
        with pytest.raises(Interrupted):
            arm.step(5)
        assert arm.session.state in (State.PAUSED, State.STOPPED)  # it is the process that ends


@pytest.mark.parametrize("presses", [
    (Event.START, Event.SUCCESS), (Event.START, Event.PAUSE, Event.DISCARD), (Event.START, Event.FAULT, Event.FAILURE),
])  # fmt: skip
def test_an_episode_that_is_over_before_the_loop_looks_is_one(arm: Bench, presses: tuple[Event, ...]) -> None:
    """Else the loop would wait for a start that the session refuses, since it waits for the loop."""

    def press() -> None:
        arm.soon(lambda: not arm.session.busy)
        for event in presses:
            if Event.FAULT in presses and event in LABELS:
                arm.soon(arm.is_state(State.LABELLING))
            arm.do(event)

    arm.session.expect(0)
    arm.meanwhile(press)
    arm.env.reset(0)
    outcome = arm.step(5)
    assert outcome.ended
    assert outcome.skipped
    assert arm.session.labels == {0: LABELS[presses[-1]]}
    arm.begin()
    assert not arm.step(5).ended


def test_what_a_person_sees() -> None:
    with bench(cameras=("upper_wrist",)) as seeing:
        shown = seeing.display.shown
        seeing.soon(lambda: seeing.display.shown > shown + 2)  # before any episode
        seeing.begin()
        for _ in range(4):
            seeing.step(2)
        assert seeing.display.said["limited"] == "no goal"
        assert 0 < float(seeing.display.said["rate_hz"]) < 2 * FPS
        seeing.step(200)
        seeing.step(200)
        assert "step 2" in str(seeing.display.said["limited"])
        assert "joint limit" not in str(seeing.display.said["limited"])  # it is still far from there
        assert seeing.env.render().shape == (16, 16, 3)
        assert "Control: " in seeing.env.summary()
        shown = seeing.display.shown
        seeing.do(Event.PAUSE)
        seeing.soon(lambda: seeing.display.shown > shown + 2)  # while it is held
