"""The loop: offline updates on the demonstrations, then acting and learning (Algorithm 2)."""

import contextlib
import sys
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lerobot_cqn.learner import Learner, NonFiniteLossError
from lerobot_cqn.schema import Batch

from ..agent import Agent
from ..clock import REAL, Clock
from ..config import RunConfig
from ..interfaces import Interrupted, Label, Monitor
from ..replay.buffer import Replay
from ..replay.course import Course, Shown, describe
from ..replay.demonstrations import counts_as_demonstration
from ..replay.episode import Episode
from ..replay.files import Place
from ..run.checkpoint import Counters
from ..run.durable import SpareDescriptors, check_room
from ..run.first_look import save_batch, write_films
from ..run.judgement import unconverged
from ..run.metrics import Metrics, read_rows
from .acting import Finished, Turn
from .background import Background
from .diagnosis import diagnose, episode_rows, shown_in
from .evaluate import EVAL_SEED, FINAL_SEED, Evaluation
from .experience import Experience

__all__ = ["Trainer"]

RECENT = 20  # training episodes in the progress line
OFFLINE_SAVE_S = 120.0  # between checkpoints on the way through the offline phase
SET_ASIDE = 5  # discarded episodes that may still be labelled otherwise


@dataclass(kw_only=True)
class Trainer:
    """The loop, with everything it touches."""

    config: RunConfig
    agent: Agent
    learner: Learner
    experience: Experience
    replay: Replay
    metrics: Metrics
    monitor: Monitor
    rng: np.random.Generator
    counters: Counters
    save: Callable[[], None]
    should_stop: Callable[[], bool]
    spare: SpareDescriptors
    evaluations: list[tuple[str, Evaluation]] = field(default_factory=list)
    finished_since: Sequence[Place] = ()
    _aside: dict[int, tuple[Episode, dict[str, Any]]] = field(default_factory=dict)
    _recent: list[bool] = field(default_factory=list)
    clock: Clock = REAL
    _counted_at: float = field(init=False)
    _shown: Shown = field(init=False)
    _learned: int = field(init=False)  # control steps whose updates are made, or owed
    _number: int = field(init=False)  # of the next turn

    def __post_init__(self) -> None:
        self._counted_at, self._shown = self.clock.now, shown_in(self.replay)
        self._learned, self._number = self.counters.env_steps, self.counters.episodes

    def run(self) -> None:
        """Offline phase, online phase, final evaluation. Raises Interrupted between two updates or steps."""
        self.experience.open([key for place in self.replay.places if (key := place.note.get("key"))])
        if self.counters == Counters():
            self.save()  # from here on the run can be continued
        self.take_up(self.finished_since)
        try:
            if not self.counters.offline_done:
                self._offline()
            self._online()
            self.evaluate("final", self.config.final_episodes)
        finally:
            self._correct()  # what was said since the last episode, before a stop
        self.save()

    def _offline(self) -> None:
        total = self.config.offline_updates
        self.monitor.phase("offline", total, self.counters.updates)
        self.experience.learning("offline updates")
        while self.replay.episodes and self.counters.updates < total:
            until = self.clock.now + OFFLINE_SAVE_S
            self.updates(
                total - self.counters.updates,
                on_update=self._tell_offline,
                until=lambda until=until: self.clock.now > until,  # type: ignore[misc]
            )
            if self.counters.updates < total:
                self.save()
        fell = unconverged(read_rows(self.metrics.output_dir / "updates.csv"))
        if fell is not None:
            self.monitor.message(
                f"Imitation has not converged: its loss fell by {fell:.0%} in the last tenth of the offline updates; "
                "give more --offline_updates."
            )
        if total and self.config.steps:
            self.evaluate("offline", self.config.final_episodes)
        self.counters.offline_done = True
        self.save()

    def _tell_offline(self) -> None:
        self.monitor.advance(self.counters.updates, "")
        self.experience.tend(self.agent, self._turn, sys.maxsize)  # no turn begins yet

    def _online(self) -> None:
        c = self.counters
        self.monitor.phase(*self._online_progress())
        while c.env_steps < self.config.steps and not self._out_of_time():
            before, began, waited = c.env_steps, self.clock.now, self.experience.waited_s
            self.episode()
            self._correct()
            self.learn(self.config.recipe.updates_of_episode(c.env_steps))
            c.online_s += self.clock.now - began - (self.experience.waited_s - waited)
            self._look_and_save(before)
        for finished in self.experience.rest():
            self._store(finished)
            self._learn_steps()
            self.learn(self.config.recipe.updates_of_episode(c.env_steps))

    def _look_and_save(self, before: int) -> None:
        """Evaluate and save where the steps since `before` say so."""
        c, freq = self.counters, self.config.eval_freq
        if freq and c.env_steps // freq > before // freq and c.env_steps < self.config.steps:
            self.evaluate("online", self.config.eval.n_episodes)
        check_room(self.metrics.output_dir)  # while a last checkpoint still fits
        if c.env_steps // self.config.save_freq > before // self.config.save_freq:
            self.experience.learning("saving a checkpoint")
            self.save()

    def episode(self) -> None:
        """Take in the next episode, learn while it is acted or afterwards, and store what happened."""
        c, before, owed = self.counters, self.counters.env_steps, self.counters.owed
        agent, beside = self.agent, None
        if self.config.async_updates:  # what acts is a copy, while the original learns beside it
            agent = replace(agent, policy=deepcopy(agent.policy))
            beside = Background(lambda stop: self.updates(self.config.async_updates, until=stop))

        def on_step(steps: int) -> None:
            nonlocal beside
            if beside is not None:  # the episode has begun
                learning.enter_context(beside)
                beside = None
            c.env_steps = steps
            self._learn_steps()
            if self.should_stop():
                raise Interrupted

        finished: Finished | None = None
        try:
            with contextlib.ExitStack() as learning:
                finished = self.experience.collect(agent, self._turn, on_step)
        finally:
            c.env_steps = before
            if finished is None:  # it is dropped: neither its steps count nor what was still to be learned in it
                self._learned, c.owed = before, owed
            else:  # also where the learner beside it failed: the person's work is not lost
                with self.spare.given():
                    self._store(finished)
        self._learn_steps()

    def _turn(self, waiting: int) -> Turn | None:
        """The next episode to act, where `waiting` control steps are not stored yet; None: the run has enough.

        Its scene follows from its number: a resumed run meets the same.
        """
        if self.counters.env_steps + waiting >= self.config.steps or self._out_of_time():
            return None
        number, steps = self._free_number(), self.counters.env_steps + waiting
        return Turn(number=number, seed=self.config.seed * 100_000 + number, steps=steps)

    def _free_number(self) -> int:
        """A number that no other episode of the run has."""
        number = max(self._number, self.counters.episodes)
        self._number = number + 1
        return number

    def _learn_steps(self) -> None:
        """Make the updates of the control steps that have none yet."""
        before, self._learned = self._learned, self.counters.env_steps
        self.learn(self.config.recipe.updates_of_steps(before, self._learned))

    def learn(self, count: int) -> None:
        """Make `count` updates and those still owed; what an interrupt leaves is owed, also by a resumed run."""
        if not self.replay.episodes:  # without demonstrations learning begins after the first episode
            return
        self.counters.owed += count
        self.updates(self.counters.owed, on_update=self._made_one)

    def _made_one(self) -> None:
        self.counters.owed -= 1
        self.experience.learning(f"update {self.counters.updates}")
        self.experience.tend(self.agent, self._turn, self.counters.owed)

    def _store(self, finished: Finished) -> None:
        """Keep a finished episode and say how it went."""
        c, turn, episode = self.counters, finished.turn, finished.episode
        taken = any(place.number == turn.number for place in self.replay.places)
        number = self._free_number() if taken else turn.number
        c.episodes, c.env_steps = max(c.episodes, number + 1), c.env_steps + finished.steps
        if episode is None:
            self.monitor.message(f"Episode {number} had no step.")
            return
        demo = counts_as_demonstration(self.config.recipe, success=finished.success)
        values = finished.values
        row = {
            "episode": number, "length": len(episode), "success": int(finished.success),
            "return": float(episode.reward.sum()), "mean_q": float(values.mean()),
            **describe(Course(states=episode.low_dim, actions=episode.action, values=values), self._shown),
            "taught": sum(last - first for first, last in episode.taught),
            "demonstrations": self.replay.demonstrations + demo, **self._progress(),
        } | ({"key": turn.key} if turn.key else {})  # fmt: skip
        if finished.discarded:
            self._aside = dict([*self._aside.items(), (number, (episode, row))][-SET_ASIDE:])
            self.monitor.message(f"Episode {number} is discarded: nothing is learned from it.")
        else:
            self.replay.add(episode, demo=demo, number=number, note=row)
            self.metrics.write("episodes", row)
            self._recent = [*self._recent, finished.success][-RECENT:]
            lately = f"success {sum(self._recent)}/{len(self._recent)} lately"
            steps = f"step {c.env_steps}  " if self.config.online_minutes is not None else ""
            note = f"{steps}episode {c.episodes}  {lately}  Q {values.mean():+.2f}"
            self.monitor.advance(self._online_progress()[2], "  ".join(filter(None, (note, self.experience.note))))
        self.experience.stored(finished)

    def _correct(self) -> None:
        """Learn from now on what a person says otherwise about finished episodes."""
        for number, label in self.experience.take_corrected().items():
            success = label is Label.SUCCESS
            demo = counts_as_demonstration(self.config.recipe, success=success)
            if label is Label.DISCARD:
                there = self.replay.forget(number)
            else:
                if number in self._aside:
                    episode, row = self._aside.pop(number)
                    self.replay.add(replace(episode, terminated=True), demo=demo, number=number, note=row)
                    self.metrics.write("episodes", row | {"success": int(success)})
                there = self.replay.correct(number, success=success, demo=demo)
            gone = "" if there else " It is not in the replay any more: nothing changes."
            self.monitor.message(f"Episode {number} is a {label} now.{gone}")

    def _online_progress(self) -> tuple[str, int, int]:
        """Name, total and done of the online phase, in what ends it: control steps, or seconds."""
        minutes = self.config.online_minutes
        if minutes is None:
            return "online", self.config.steps, self.counters.env_steps
        return "online, seconds", round(60 * minutes), int(self.counters.online_s)

    def _out_of_time(self) -> bool:
        minutes = self.config.online_minutes
        return minutes is not None and self.counters.online_s >= 60 * minutes

    def updates(
        self, count: int, on_update: Callable[[], None] = lambda: None, until: Callable[[], bool] = lambda: False
    ) -> None:
        """Gradient updates on batches from both stores, the next one put together meanwhile."""
        if not self.replay.episodes:  # without demonstrations learning begins after the first episode
            return
        sizes = self.config.recipe.batch_size, self.config.recipe.demo_batch_size
        with contextlib.closing(self.replay.batches(count, *sizes, self.rng)) as batches:
            for batch in batches:
                stats = self._update(batch)
                self.counters.updates += 1
                if self.counters.updates % self.config.log_freq == 0:
                    losses = {name: float(value) for name, value in stats.items()}
                    self.metrics.write("updates", losses | self._progress())
                on_update()
                if self.should_stop():
                    raise Interrupted
                if until():
                    break

    def _update(self, batch: Batch) -> dict[str, Any]:
        try:
            return self.learner.update(batch)
        except NonFiniteLossError as error:
            path = self.metrics.output_dir / "bad_batch.pt"
            save_batch(batch, path)
            raise NonFiniteLossError(f"{error} The batch is in {path}.") from error

    def take_up(self, places: Sequence[Place]) -> None:
        """Episodes that were finished after the last checkpoint: they count, and their updates are made again."""
        recipe, owed = self.config.recipe, 0
        # In the order of their ends: one that was discarded at first was stored after later ones.
        for place in sorted(places, key=lambda place: (int(place.note["env_steps"]), place.number)):
            self.metrics.write("episodes", place.note)
            before, after = self.counters.env_steps, int(place.note["env_steps"])
            self.counters.episodes = max(self.counters.episodes, place.number + 1)
            self.counters.env_steps = self._learned = max(before, after)
            owed += recipe.updates_of_steps(before, max(before, after)) + recipe.updates_of_episode(after)
        if places:
            self.monitor.message(
                f"{len(places)} episodes that ended after the last checkpoint are kept; their {owed} updates are made "
                "again."
            )
        self.learn(owed)

    def evaluate(self, phase: str, episodes: int) -> None:
        """Success rate of the deterministic policy; its random state is kept apart from training's."""
        if not episodes:
            return

        def look() -> None:
            if self.should_stop():
                raise Interrupted

        films, seed = self.config.eval.videos, EVAL_SEED if phase == "online" else FINAL_SEED
        result = self.experience.evaluate(self.agent, episodes, seed, look, films)
        rows = episode_rows(result, self._shown, self.experience.max_steps)
        if films:
            stem = f"{phase}_{self.counters.env_steps:06d}"
            labels = [f"failure {each['how']}".replace(" ", "_") if each["how"] else "success" for each in rows]
            write_films(result.frames, labels, self.metrics.output_dir / "videos", stem, self.experience.fps)
        self.evaluations.append((phase, result))
        low, high = result.interval
        row = {
            "phase": phase, "episodes": self.counters.episodes, "n": result.n, "successes": result.successes,
            "success_rate": result.success_rate, "ci_low": low, "ci_high": high,
            "mean_length": float(np.mean(result.steps)), "mean_return": result.mean_return,
            "standing_failures": result.standing_failures,
        }  # fmt: skip
        progress = self._progress()
        self.metrics.write("evaluations", row | progress)
        for scene, each in enumerate(rows, seed - EVAL_SEED):
            self.metrics.write("evaluation_episodes", {"phase": phase, "scene": scene, **each, **progress})
        found = diagnose(self.learner.model, self.replay, self.counters.updates)
        self.metrics.write("diagnosis", {"phase": phase, **found, **progress})
        self.monitor.message(f"{phase:>8}  step {self.counters.env_steps:>6}  {result}")

    def _progress(self) -> dict[str, float]:
        now = self.clock.now
        self.counters.wall_s += now - self._counted_at
        self._counted_at = now
        c = self.counters
        return {"env_steps": c.env_steps, "updates": c.updates, "wall_s": round(c.wall_s, 2)}
