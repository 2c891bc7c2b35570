"""`cqn-train` on the simulated arm, with a person who is a thread: what is learned from, stored, and taken up again."""

import contextlib
import functools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_train.arguments import parse
from cqn_train.arm.environment import ArmEnvironment
from cqn_train.build import build
from cqn_train.interfaces import Interrupted, Label
from cqn_train.loop.trainer import Trainer
from cqn_train.operator.session import Event, RefusedError, Session, State
from cqn_train.replay.files import Place
from cqn_train.run.progress import ConsoleMonitor
from cqn_train.sim_arm import SimUR5eConfig
from cqn_train.sim_arm.sim_ur5e import SimUR5e
from cqn_train.sim_arm.world import WORLDS

from ..driven_clock import DrivenClock, until
from .arm_bench import FPS, HOME_DEG, RAMP_S, SPEED, Display
from .conftest import TINY_POLICY
from .test_cqn_train import tables

pytest.importorskip("mujoco")
S, F, D = Event.SUCCESS, Event.FAILURE, Event.DISCARD


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Three short ones: from home to one side, absolute goals."""
    root = tmp_path_factory.mktemp("arm_training") / "data"
    robot = SimUR5e(SimUR5eConfig(camera_names=[], state=True))
    state, action = list(robot.observation_features), list(robot.action_features)
    features: dict[str, Any] = {
        "action": {"dtype": "float32", "shape": (len(action),), "names": action},
        "observation.state": {"dtype": "float32", "shape": (len(state),), "names": state},
    }
    dataset = LeRobotDataset.create("local/arm", fps=FPS, features=features, root=root, use_videos=False)
    for number in range(3):
        for step in range(12):
            joints = HOME_DEG + np.append(np.sin([step / (3 + number + i) for i in range(6)]) * 15, 5 * step)
            seen = np.append(joints, [0.1 * number, 0.01 * step, 0.0])
            frame = {"action": joints.astype(np.float32), "observation.state": seen.astype(np.float32)}
            dataset.add_frame({**frame, "task": "Press the red button."})
        dataset.save_episode()
    dataset.finalize()
    return ["--dataset.repo_id=local/arm", f"--dataset.root={root}"]


ARM = [
    *TINY_POLICY, "--robot.type=sim_ur5e", f"--robot.speed={SPEED}", f"--robot.ramp_s={RAMP_S}",
    "--robot.camera_names=[]", "--robot.state=true", "--teleop.type=sim_leader", "--operator_page=false",
    "--batch_size=4", "--demo_batch_size=4", "--updates_per_episode=2", "--log_freq=1", "--save_freq=100000",
    "--arm.home_speed=1",
]  # fmt: skip


def drive(monkeypatch: pytest.MonkeyPatch) -> DrivenClock:
    """By which trainer, arm and person live; a thread steers the session itself, since keys would need a terminal."""
    clock = DrivenClock()
    monkeypatch.setattr("cqn_train.build.steering", lambda *_: contextlib.nullcontext())
    monkeypatch.setattr(SimUR5e, "clock", clock)
    return clock


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> DrivenClock:
    return drive(monkeypatch)


class Hands:
    """A person: starts episodes, labels them as planned after some steps, says that the scene is ready.

    during: what else is done in an episode, by its number, before its label.
    """

    def __init__(
        self, session: Session, env: ArmEnvironment, plan: list[Event], clock: DrivenClock, steps: int = 6
    ) -> None:
        self.session, self.env, self.plan, self.clock, self.steps = session, env, plan, clock, steps
        self.during: dict[int, Callable[[], Any]] = {}
        self.errors: list[BaseException] = []
        self.leave = threading.Event()
        self._thread = clock.thread(self._run, "person")

    def __enter__(self) -> "Hands":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.leave.set()
        self._thread.join(10)

    def _run(self) -> None:
        try:
            for label in self.plan:
                self._episode(label)
        except BaseException as error:
            if not self.leave.is_set():
                self.errors.append(error)
        with contextlib.suppress(RefusedError):
            self.session.apply(Event.STOP)

    def _episode(self, label: Event) -> None:
        session, soon = self.session, functools.partial(until, self.clock)
        soon(lambda: self.leave.is_set() or Event.START in session.allowed() or Event.READY in session.allowed())
        if session.state is State.RESETTING:
            session.apply(Event.READY)
        soon(lambda: self.leave.is_set() or Event.START in session.allowed())
        session.apply(Event.START)
        self.drive(self.steps)
        self.during.get(session.episode, lambda: None)()
        if session.state is not State.STOPPED:
            session.apply(label)

    def drive(self, steps: int) -> None:
        """Let it go on for so many steps."""
        begun, soon = self.session.episode, functools.partial(until, self.clock)
        soon(lambda: self.env.display.begun[-1:] == [begun])  # type: ignore[attr-defined]
        goal = self.env._steps + steps
        soon(lambda: self.leave.is_set() or self.env._steps >= goal)


def run(
    arguments: list[str],
    plan: list[Event],
    prepare: Callable[[Trainer, Hands], Any] = lambda _t, _h: None,
    asked: list[bool] | None = None,
) -> tuple[Trainer, bool]:
    """Train until the plan is done, the run is complete, or fails; returns the trainer, and whether it was stopped."""
    stopped = False
    with ConsoleMonitor() as monitor, contextlib.ExitStack() as stack:
        trainer = build(parse(arguments).validate(), monitor, lambda: bool(asked), stack, SimUR5e.clock)
        assert isinstance(trainer.experience.env, ArmEnvironment)
        assert isinstance(trainer.experience.person, Session)
        assert isinstance(trainer.clock, DrivenClock)
        trainer.experience.env.display = Display()
        hands = Hands(trainer.experience.person, trainer.experience.env, plan, trainer.clock)
        prepare(trainer, hands)
        with hands:
            try:
                trainer.run()
            except Interrupted:
                stopped = True
                trainer.save()
        assert not hands.errors, hands.errors
    assert WORLDS == {}  # disconnected
    return trainer, stopped


def places(trainer: Trainer) -> dict[int, Place]:
    """Episodes of the run that are learned from, by number."""
    return {place.number: place for place in trainer.replay._places[trainer.replay._fixed :]}


def last_reward(trainer: Trainer, place: Place) -> float:
    return float(trainer.replay._rows["reward"].read(place.start, place.stop)[place.length - 1])


def test_labels_and_second_thoughts(demonstrations: list[str], tmp_path: Path) -> None:
    def prepare(trainer: Trainer, hands: Hands) -> None:
        session = hands.session
        hands.during[4] = lambda: (
            session.correct(0, Label.FAILURE), session.correct(1, Label.SUCCESS), session.correct(2, Label.SUCCESS),
            session.correct(3, Label.DISCARD),
        )  # fmt: skip

    trainer, stopped = run([*ARM, *demonstrations, f"--output_dir={tmp_path / 'run'}"], [S, F, D, S, F], prepare)
    assert stopped
    found = places(trainer)
    assert {n: (p.success, p.terminated, p.demo, last_reward(trainer, p)) for n, p in sorted(found.items())} == {
        0: (False, True, False, 0.0),
        1: (True, True, True, 1.0),
        2: (True, True, True, 1.0),
        4: (False, True, False, 0.0),
    }
    assert trainer.replay.demonstrations == 3 + 2
    rows = {int(row["episode"]): row for row in tables(tmp_path / "run")["episodes"]}
    assert sorted(rows) == [0, 1, 2, 3, 4]
    assert {number: int(row["success"]) for number, row in rows.items()} == {
        0: 1,
        1: 0,
        2: 1,
        3: 1,
        4: 0,
    }  # at the time
    assert all(int(rows[n]["length"]) == p.length >= 6 for n, p in found.items())
    assert trainer.counters.episodes == 5
    assert trainer.counters.env_steps == sum(int(row["length"]) for row in rows.values())
    assert trainer.counters.updates == 5 * 2


def test_what_a_person_drives_is_learned_from_though_it_failed(demonstrations: list[str], tmp_path: Path) -> None:
    sent: list[np.ndarray] = []

    def prepare(trainer: Trainer, hands: Hands) -> None:
        step = trainer.experience.env.step

        def spy(action: Any) -> Any:
            outcome = step(action)
            if not outcome.skipped and outcome.sent is not None:
                sent.append(np.append(outcome.sent[0].numpy(), outcome.taught))
            return outcome

        trainer.experience.env.step = spy  # type: ignore[method-assign]
        hands.during[0] = lambda: (
            hands.session.apply(Event.TAKE_OVER), hands.drive(8), hands.session.apply(Event.PAUSE),
            hands.clock.sleep(0.05), hands.session.apply(Event.RESUME), hands.drive(4),
        )  # fmt: skip

    trainer, _ = run([*ARM, *demonstrations, f"--output_dir={tmp_path / 'run'}"], [F], prepare)
    (place,) = places(trainer).values()
    ((first, last),) = place.taught
    row = tables(tmp_path / "run")["episodes"][0]
    assert int(row["taught"]) == last - first >= 8
    assert place.length == len(sent) == int(row["length"])  # the steps of the pause are not there
    assert [bool(goal[-1]) for goal in sent] == [first <= t < last for t in range(place.length)]
    action = trainer.replay._rows["action"].read(place.start, place.stop)[:-1]
    post = trainer.agent.postprocessor
    undone = np.stack([post(torch.from_numpy(a)[None].clone())[0].numpy() for a in action])
    inside = np.abs(action) < 1  # beyond the demonstrations the nearest action that the policy has
    taught = slice(first, last)
    assert inside[taught].sum() > 8
    np.testing.assert_allclose(undone[taught][inside[taught]], np.stack(sent)[taught, :7][inside[taught]], atol=0.02)
    shown = trainer.replay.sample(0, 400, np.random.default_rng(0)).demo
    assert bool((shown == 1).all())


def test_a_stopped_run_goes_on_with_the_next_number(demonstrations: list[str], tmp_path: Path) -> None:
    folder = f"--output_dir={tmp_path / 'run'}"

    def stop_in_the_middle(trainer: Trainer, hands: Hands) -> None:
        hands.during[2] = lambda: hands.session.apply(Event.STOP)

    first, stopped = run([*ARM, *demonstrations, folder], [S, F], stop_in_the_middle)
    assert stopped
    assert first.counters.episodes == 2
    again, stopped = run(["--resume=true", folder], [D, S])
    assert stopped
    assert sorted(places(again)) == [0, 1, 3]
    assert again.counters.episodes == 4
    assert isinstance(again.experience.person, Session)
    assert again.experience.person.labels == {2: Label.DISCARD, 3: Label.SUCCESS}
    rows = tables(tmp_path / "run")["episodes"]
    assert [int(row["episode"]) for row in rows] == [0, 1, 3]
    steps = [int(row["env_steps"]) for row in rows]
    assert steps == sorted(steps)


def test_a_killed_run_keeps_episodes_and_second_thoughts_in_order(demonstrations: list[str], tmp_path: Path) -> None:
    """What came after the last checkpoint is in the replay's files; the discarded one that counts after all is last."""
    folder = f"--output_dir={tmp_path / 'run'}"

    def die(trainer: Trainer, hands: Hands) -> None:
        saved = trainer.save
        trainer.save = lambda: saved() if not trainer.counters.episodes else None
        hands.during[3] = lambda: hands.session.correct(1, Label.SUCCESS)

    first, _ = run([*ARM, *demonstrations, folder], [S, D, F, F], die)
    assert [place.number for place in first.replay._places[3:]] == [0, 2, 3, 1]
    again, _ = run(["--resume=true", folder], [S])
    assert sorted(places(again)) == [0, 1, 2, 3, 4]
    assert again.counters.episodes == 5
    rows = tables(tmp_path / "run")["episodes"]
    assert [int(row["episode"]) for row in rows] == [0, 1, 2, 3, 4]
    steps = [int(row["env_steps"]) for row in rows]
    assert steps == sorted(steps)
    assert again.counters.env_steps == steps[-1]


def test_a_second_thought_right_before_the_stop_counts(demonstrations: list[str], tmp_path: Path) -> None:
    folder = f"--output_dir={tmp_path / 'run'}"

    def prepare(trainer: Trainer, hands: Hands) -> None:
        hands.during[2] = lambda: (
            hands.session.correct(0, Label.FAILURE), hands.session.correct(1, Label.SUCCESS),
            hands.session.apply(Event.STOP),
        )  # fmt: skip

    trainer, _ = run([*ARM, *demonstrations, folder], [S, D, S], prepare)
    assert {n: p.success for n, p in places(trainer).items()} == {0: False, 1: True}
    again, _ = run(["--resume=true", folder], [])
    assert {n: p.success for n, p in places(again).items()} == {0: False, 1: True}
    assert again.counters.episodes == 2


def test_minutes_are_of_acting_and_learning_and_not_of_waiting(
    demonstrations: list[str], tmp_path: Path, clock: DrivenClock
) -> None:
    shown: list[tuple[int, str]] = []

    def prepare(trainer: Trainer, hands: Hands) -> None:
        session, advance = hands.session, trainer.monitor.advance
        hands.during[0] = lambda: (session.apply(Event.PAUSE), hands.clock.sleep(1.0), session.apply(Event.RESUME))

        def noted(done: int, note: str) -> None:
            if note.startswith("step "):
                shown.append((done, note))
            advance(done, note)

        trainer.monitor.advance = noted  # type: ignore[method-assign]

    arguments = [*ARM, *demonstrations, f"--output_dir={tmp_path / 'run'}", "--online_minutes=0.012"]
    began = clock.now
    trainer, stopped = run(arguments, [F] * 30, prepare)
    passed = clock.now - began
    assert not stopped  # the run is complete
    assert trainer.counters.episodes >= 2
    assert trainer.experience.env.waited_s >= 0.5  # of the pause, once it is noticed
    assert 0.72 <= trainer.counters.online_s <= passed - trainer.experience.env.waited_s
    assert len(shown) == trainer.counters.episodes
    assert all(done <= 1 for done, _ in shown)  # seconds of 0.72, not steps of 30,000
    assert (tmp_path / "run/checkpoints/last/pretrained_model").is_dir()


def test_learning_beside_an_episode(demonstrations: list[str], tmp_path: Path) -> None:
    """Updates go on while the arm is driven by a copy that does not change, and end with the episode."""
    beside: list[str] = []
    learned = threading.Semaphore(0)

    def prepare(trainer: Trainer, hands: Hands) -> None:
        update = trainer._update

        def spy(batch: Any) -> Any:
            beside.append(threading.current_thread().name)
            stats = update(batch)
            if beside[-1] == "updates":
                learned.release()
            return stats

        def wait() -> None:  # the updates take a time of their own, and an episode here nearly none
            assert all(learned.acquire(timeout=60) for _ in range(5))

        trainer._update = spy  # type: ignore[method-assign]
        hands.during = {0: wait, 1: wait}

    arguments = [*ARM, *demonstrations, f"--output_dir={tmp_path / 'run'}", "--async_updates=5"]
    trainer, _ = run(arguments, [S, F], prepare)
    assert beside[:7] == ["updates"] * 5 + ["MainThread"] * 2
    assert trainer.counters.updates == len(beside) == 14
    assert sorted(places(trainer)) == [0, 1]


def test_an_error_beside_an_episode_ends_the_run_and_not_the_episode(demonstrations: list[str], tmp_path: Path) -> None:
    folder = f"--output_dir={tmp_path / 'run'}"

    def fail(trainer: Trainer, hands: Hands) -> None:
        trainer._update = lambda _: 1 / 0  # type: ignore[method-assign,assignment,return-value]

    with pytest.raises(ZeroDivisionError):
        run([*ARM, *demonstrations, folder, "--async_updates=5"], [S], fail)
    assert WORLDS == {}
    again, _ = run(["--resume=true", folder], [F])
    assert {n: p.success for n, p in places(again).items()} == {0: True, 1: False}
    assert [int(row["episode"]) for row in tables(tmp_path / "run")["episodes"]] == [0, 1]


def test_ctrl_c_in_an_episode_drops_it_and_saves(demonstrations: list[str], tmp_path: Path) -> None:
    folder, asked = f"--output_dir={tmp_path / 'run'}", list[bool]()

    def prepare(trainer: Trainer, hands: Hands) -> None:
        hands.during[1] = lambda: (
            asked.append(True),
            hands.clock.wait(hands.leave, 5),
            hands.session.apply(Event.STOP),
        )

    trainer, stopped = run([*ARM, *demonstrations, folder], [S, F], prepare, asked)
    assert stopped
    assert (trainer.counters.episodes, sorted(places(trainer))) == (1, [0])
    assert trainer.counters.env_steps == places(trainer)[0].length
    again, _ = run(["--resume=true", folder], [F])
    assert sorted(places(again)) == [0, 1]


def test_evaluations_on_an_arm_are_not_learned_from(demonstrations: list[str], tmp_path: Path) -> None:
    def prepare(trainer: Trainer, hands: Hands) -> None:
        def pause() -> None:
            assert Event.TAKE_OVER not in hands.session.allowed()
            hands.session.apply(Event.PAUSE)
            hands.clock.sleep(0.05)
            hands.session.apply(Event.RESUME)

        hands.during[-1] = pause

    arguments = [*ARM, *demonstrations, f"--output_dir={tmp_path / 'run'}", "--steps=6", "--eval.final_n_episodes=2"]
    trainer, stopped = run(arguments, [F, S, F], prepare)
    assert not stopped
    assert sorted(places(trainer)) == [0]
    rows = tables(tmp_path / "run")["evaluations"]
    assert [(row["phase"], row["n"], row["successes"]) for row in rows] == [("final", "2", "1")]
    assert int(rows[0]["episodes"]) == 1
