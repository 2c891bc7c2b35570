"""What goes wrong with an arm, at every moment, judged in the simulator: joints, their speed, and what is recorded."""

from collections.abc import Callable

import numpy as np
import pytest

from cqn_train.arm import attendant
from cqn_train.interfaces import Interrupted, Label, Outcome
from cqn_train.operator.session import Event, State
from cqn_train.robot.readings import RobotFault
from cqn_train.sim_arm import FAULTS, Fault

from .arm_bench import FPS, HOME_DEG, SPEED, STEP_DEG, Bench, bench

pytest.importorskip("mujoco")

# Real seconds for which each fault lasts (longer than it may stay unnoticed), its amount, and how many steps may be
# recorded before it is noticed: what stands still is a fault only after `stale_s` of 0.3 s, twelve steps.
LASTS = {
    "disconnect": (0.25, 0.0, 0), "send_error": (0.25, 0.0, 0), "delay": (0.3, 0.6, 0), "frozen_camera": (0.6, 0.0, 14),
    "frozen_joints": (0.7, 0.0, 16), "stuck_joint": (0.5, 1.0, 1000), "nan": (0.25, 0.0, 0), "error": (0.25, 0.0, 0),
}  # fmt: skip
SAID = {
    "disconnect": "injected fault 'disconnect'", "send_error": "takes no goal", "delay": "Reading the robot took",
    "frozen_camera": "camera 'upper_wrist' has not changed", "frozen_joints": "joints have not changed",
    "nan": "'shoulder_pan.pos' reads nan", "error": "injected fault 'error'",
}  # fmt: skip
# What cannot be noticed while the arm is told nothing, and what is none of the guard's business.
QUIET = {"send_error", "frozen_joints", "stuck_joint"}


@pytest.fixture(autouse=True)
def _soon_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attendant, "RETRY_S", 0.05)


def inject(arm: Bench, kind: str) -> float:
    """Let it go wrong from now on; returns the real seconds for which it does."""
    seconds, amount, _ = LASTS[kind]
    with arm.world.lock:
        arm.world.catch_up()
        arm.robot.config.faults = [Fault(kind, arm.world.now, seconds * SPEED, amount)]
    return seconds


def is_over(arm: Bench) -> bool:
    with arm.world.lock:
        arm.world.catch_up()
        return not any(fault.active(arm.world.now) for fault in arm.robot.config.faults)


def drive(arm: Bench, goal: Callable[[int], tuple[float, ...]]) -> tuple[list[Outcome], Outcome, list[int]]:
    """As the loop does: what would be recorded, the end, and how many goals had been sent at each of these steps."""
    kept: list[Outcome] = []
    sent: list[int] = []
    for step in range(2000):
        outcome = arm.step(*goal(step))
        if not outcome.skipped:
            kept.append(outcome)
            sent.append(len(arm.goals))
        if outcome.ended:
            return kept, outcome, sent
    raise AssertionError("the episode does not end")


def wave(step: int) -> tuple[float, ...]:
    """Always on the move, so that what stands still is noticed."""
    return 14 * np.sin(step / 8), 10 * np.sin(step / 5)


def works_again(arm: Bench) -> None:
    """The next episode is like any other."""
    arm.robot.config.faults = []
    assert arm.session.fault == ""
    arm.begin()
    for step in range(4):
        outcome = arm.step(*wave(step))
        assert not outcome.skipped
    arm.do(Event.SUCCESS)
    assert arm.step().success
    assert arm.session.labels[arm.session.episode] is Label.SUCCESS


def cameras(kind: str) -> tuple[str, ...]:
    return ("upper_wrist",) if kind == "frozen_camera" else ()


@pytest.mark.parametrize("moment", ["driving", "teaching"])
@pytest.mark.parametrize("kind", FAULTS)
def test_faults_while_the_arm_is_driven(kind: str, moment: str) -> None:
    with bench(cameras=cameras(kind)) as arm:
        marks: dict[str, float] = {}

        def person() -> None:
            arm.soon(lambda: len(arm.goals) > 5)
            if moment == "teaching":
                arm.leader.pose = lambda: HOME_DEG + np.append(wave(len(arm.goals)), np.zeros(5))
                arm.do(Event.TAKE_OVER)
                taken = len(arm.goals)
                arm.soon(lambda: len(arm.goals) > taken + 5)
            marks["steps"] = arm.env._steps
            seconds = inject(arm, kind)
            if kind in SAID:
                arm.soon(arm.is_state(State.FAULTED))
                assert SAID[kind] in arm.session.fault
                marks["breaks"] = arm.session.breaks
                sent = len(arm.goals)
                with pytest.raises(Exception, match="label"):
                    arm.session.correct(0, Label.SUCCESS)
                arm.soon(arm.is_state(State.LABELLING))
                marks["holds"] = len(arm.goals) - sent
            else:
                arm.clock.sleep(seconds)
            arm.soon(lambda: is_over(arm))
            arm.do(Event.FAILURE)

        arm.begin()
        arm.meanwhile(person)
        kept, end, _ = drive(arm, wave)
        if kind in SAID:
            assert end.skipped  # the step in which it happened is not one
            assert marks["breaks"] == 1
            # Once it is well it is held, which is one goal; a driver that takes none is asked again.
            assert marks["holds"] <= 2
            assert len(kept) - marks["steps"] <= LASTS[kind][2] + 1
        assert arm.display.ended == [(0, len(kept))]
        assert (end.terminated, end.success, end.discarded) == (True, False, False)
        assert arm.session.labels == {0: Label.FAILURE}  # as the person said, and not before
        assert all(np.isfinite(o.frame["observation.state"].numpy()).all() for o in kept)
        assert all(o.taught for o in kept[-3:]) == (moment == "teaching")
        works_again(arm)
        arm.check(springs=kind == "stuck_joint")


@pytest.mark.parametrize("kind", FAULTS)
def test_faults_while_the_arm_is_paused(kind: str) -> None:
    with bench(cameras=cameras(kind)) as arm:
        seen: list[State] = []

        def person() -> None:
            arm.soon(lambda: arm.env._steps >= 6)
            arm.do(Event.PAUSE)
            arm.clock.sleep(0.1)
            place = arm.joints
            seconds = inject(arm, kind)
            if kind in QUIET:
                arm.clock.sleep(seconds)
                assert arm.session.state is State.PAUSED
                arm.soon(lambda: is_over(arm))
                assert np.abs(arm.joints - place).max() < 0.5
                arm.do(Event.RESUME)
                steps = arm.env._steps
                arm.soon(lambda: arm.env._steps > steps + 5)
            else:
                arm.soon(arm.is_state(State.FAULTED))
                seen.append(arm.session.state)
                arm.soon(arm.is_state(State.LABELLING))
                assert np.abs(arm.joints - place).max() < 0.5
            arm.do(Event.DISCARD)

        arm.begin()
        arm.meanwhile(person)
        kept, end, _ = drive(arm, wave)
        assert end.discarded
        assert len(kept) >= (12 if kind in QUIET else 6)
        assert arm.session.labels == {0: Label.DISCARD}
        works_again(arm)
        arm.check(springs=kind == "stuck_joint")


@pytest.mark.parametrize("kind", FAULTS)
def test_faults_before_an_episode_starts(kind: str) -> None:
    with bench(cameras=cameras(kind)) as arm:
        arm.session.learning("")
        seconds = inject(arm, kind)
        if kind in QUIET:
            arm.clock.sleep(seconds)
            assert arm.session.state is State.WAITING
        else:
            arm.soon(arm.is_state(State.FAULTED))
            with pytest.raises(Exception, match="no place while faulted"):
                arm.do(Event.START)
            arm.soon(arm.is_state(State.RESETTING))  # there was no episode to label
        arm.soon(lambda: is_over(arm))
        assert arm.session.labels == {}
        works_again(arm)
        arm.check(springs=kind == "stuck_joint")


@pytest.mark.parametrize("kind", FAULTS)
def test_faults_on_the_way_home(kind: str) -> None:
    with bench(cameras=cameras(kind), home_speed=0.3) as arm:
        arm.begin()
        for _ in range(10):
            arm.step(18, -18)
        arm.do(Event.SUCCESS)
        arm.step()
        away = arm.joints
        arm.soon(lambda: np.abs(arm.joints - away).max() > 1)
        inject(arm, kind)
        if kind == "stuck_joint":
            arm.soon(lambda: is_over(arm))
        else:
            arm.soon(arm.is_state(State.FAULTED))
            arm.soon(arm.is_state(State.RESETTING))
            arm.soon(arm.at_rest)  # whoever looked after it has the hands there: it does not set off by itself
            assert np.abs(arm.joints - HOME_DEG[:6]).max() > 2
            arm.do(Event.HOME)
        arm.soon(lambda: np.abs(arm.joints - HOME_DEG[:6]).max() < 0.5)
        assert arm.session.labels == {0: Label.SUCCESS}
        works_again(arm)
        arm.check(springs=kind == "stuck_joint")


# -- what goes wrong in the process ------------------------------------------------------------------------------------


def test_a_loop_that_stalls_leaves_an_arm_that_holds() -> None:
    with bench() as arm:
        arm.begin()
        for step in range(6):
            arm.step(*wave(step))
        sent, place = len(arm.goals), arm.joints
        arm.clock.sleep(0.25 + 0.1 + 0.2)  # the watchdog's time, its own look, and the arm's coming to rest
        assert arm.at_rest(0.45)
        assert len(arm.goals) == sent + 1
        assert np.abs(arm.joints - place).max() < 2 * STEP_DEG
        assert arm.env.arm.guard.interventions["watchdog"] == 1
        assert not arm.step(*wave(6)).skipped  # and then it goes on, without catching up
        for step in range(7, 12):
            arm.step(*wave(step))
        arm.check()


@pytest.mark.parametrize("nonsense", [np.nan, np.inf, -1e30, 1e4, -1e4])
def test_a_policy_that_says_nonsense(nonsense: float) -> None:
    with bench() as arm:
        arm.begin()
        for step in range(10):
            arm.step(*wave(step))
        for _ in range(40):
            outcome = arm.step(nonsense, -nonsense, 3.0, nonsense)
            assert outcome.sent is not None
            assert np.isfinite(outcome.sent.numpy()).all()
        name = "not finite" if not np.isfinite(nonsense) else "joint limit"
        assert arm.env.arm.guard.interventions[name] >= 20
        if np.isfinite(nonsense):  # it went as far as it may
            assert np.abs(arm.joints - HOME_DEG[:6]).max() == pytest.approx(20, abs=1)
        arm.check()


def test_a_leader_that_cannot_be_read_is_a_fault() -> None:
    with bench() as arm:

        def person() -> None:
            arm.soon(lambda: arm.env._steps >= 5)
            arm.do(Event.TAKE_OVER)
            arm.soon(lambda: arm.env._steps >= 10)
            arm.leader.pose = lambda: np.array([1 / 0])
            arm.soon(arm.is_state(State.LABELLING))
            arm.leader.pose = HOME_DEG.copy
            arm.do(Event.FAILURE)

        arm.begin()
        arm.meanwhile(person)
        kept, end, _ = drive(arm, wave)
        assert end.skipped
        assert len(kept) >= 10
        assert "leader" not in arm.session.fault  # it is over
        works_again(arm)
        arm.check()


@pytest.mark.parametrize("leap", [np.full(7, 80.0), np.full(7, -1e6), np.full(7, np.nan)])
def test_a_leader_that_leaps_drags_the_arm_slowly(leap: np.ndarray) -> None:
    with bench() as arm:
        arm.begin()
        arm.do(Event.TAKE_OVER)
        for _ in range(5):
            arm.step()
        arm.leader.pose = lambda: HOME_DEG + leap
        arm.meanwhile(lambda: (arm.clock.sleep(0.4), arm.do(Event.FAILURE) if np.isfinite(leap).all() else None))
        if np.isfinite(leap).all():
            drive(arm, wave)
        else:
            arm.meanwhile(lambda: (arm.soon(arm.is_state(State.LABELLING)), arm.do(Event.FAILURE)))
            kept, end, _ = drive(arm, wave)
            assert kept == []
            assert end.skipped
        arm.check()


def test_an_arm_that_starts_outside_its_limits_does_not_leap() -> None:
    """A folded arm is often outside of what demonstrations saw; and it is paused, which holds it where it is."""
    place = np.radians(HOME_DEG[:6] + np.array([35.0, -30.0, 0, 0, 0, 0]))
    with bench(start=place) as arm:
        arm.world.fastest = 0.0
        arm.begin()
        for step in range(30):
            arm.step(0, 0)
            if step == 3:
                arm.do(Event.PAUSE)
                arm.meanwhile(lambda: (arm.clock.sleep(0.1), arm.do(Event.RESUME)))
        assert np.degrees(arm.world.fastest) * SPEED <= 1.6 * STEP_DEG * FPS
        assert np.abs(arm.joints - HOME_DEG[:6]).max() < 1


@pytest.mark.parametrize("kind", ["disconnect", "nan", "error"])
def test_an_arm_that_is_out_of_order_from_the_start_is_said_in_one_line(kind: str) -> None:
    def begin() -> None:
        with bench(faults=(Fault(kind, 0.0),)):
            raise AssertionError("it must not open")

    with pytest.raises(RobotFault, match=r"The robot cannot be read|reads nan") as raised:
        begin()
    assert "\n" not in str(raised.value)
    with bench() as arm:  # and nothing of it is left connected
        assert arm.session.state is State.WAITING


def test_a_fault_that_does_not_end_can_be_stopped() -> None:
    with bench() as arm:
        arm.begin()
        arm.step(1)
        arm.robot.config.faults = [Fault("disconnect", 0.0)]
        arm.meanwhile(lambda: (arm.soon(arm.is_state(State.FAULTED)), arm.clock.sleep(0.2), arm.do(Event.STOP)))
        with pytest.raises(Interrupted):
            arm.step(2)
        assert arm.session.labels == {}
        arm.check()
