"""The loop: offline updates on the demonstrations, then acting and learning (Algorithm 2)."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.learner import Learner, NonFiniteLossError
from lerobot_cqn.schema import Batch

from ..agent import Agent
from ..clock import REAL, Clock
from ..config import RunConfig
from ..interfaces import Environment, Interrupted, Label, Monitor, Outcome, Person, Scenes
from ..replay.buffer import Replay
from ..replay.course import Course, Shown, describe
from ..replay.demonstrations import counts_as_demonstration
from ..replay.episode import Episode
from ..replay.files import Place
from ..replay.recorder import Recorder
from ..run.checkpoint import Counters
from ..run.durable import SpareDescriptors, check_room
from ..run.first_look import save_batch, write_films
from ..run.judgement import unconverged
from ..run.metrics import Metrics, read_rows
from .background import Background
from .diagnosis import diagnose, episode_rows, shown_in
from .evaluate import EVAL_SEED, FINAL_SEED, Evaluation, evaluate

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
    env: Environment
    scenes: Scenes
    replay: Replay
    metrics: Metrics
    monitor: Monitor
    rng: np.random.Generator
    counters: Counters
    save: Callable[[], None]
    should_stop: Callable[[], bool]
    person: Person
    spare: SpareDescriptors
    evaluations: list[tuple[str, Evaluation]] = field(default_factory=list)
    finished_since: Sequence[Place] = ()
    _aside: dict[int, tuple[Episode, dict[str, Any]]] = field(default_factory=dict)
    _recent: list[bool] = field(default_factory=list)
    clock: Clock = REAL
    _counted_at: float = field(init=False)
    _shown: Shown = field(init=False)

    def __post_init__(self) -> None:
        self._counted_at, self._shown = self.clock.now, shown_in(self.replay)

    def run(self) -> None:
        """Offline phase, online phase, final evaluation. Raises Interrupted between two updates or steps."""
        self.env.open()
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
        self.person.learning("offline updates")
        while self.replay.episodes and self.counters.updates < total:
            until = self.clock.now + OFFLINE_SAVE_S
            self.updates(
                total - self.counters.updates,
                on_update=lambda: self.monitor.advance(self.counters.updates, ""),
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

    def _online(self) -> None:
        c = self.counters
        self.monitor.phase(*self._online_progress())
        while c.env_steps < self.config.steps and not self._out_of_time():
            before, number, began, waited = c.env_steps, c.episodes, self.clock.now, self.env.waited_s
            try:
                self.episode()
            except (Interrupted, OSError):  # the unfinished episode is dropped, so its steps do not count either
                c.env_steps = before if c.episodes == number else c.env_steps
                raise
            self._correct()
            self.updates(self.config.recipe.updates_of_episode(c.env_steps), on_update=self._tell_updates)
            c.online_s += self.clock.now - began - (self.env.waited_s - waited)
            self._look_and_save(before)

    def _look_and_save(self, before: int) -> None:
        """Evaluate and save where the steps since `before` say so."""
        c, freq = self.counters, self.config.eval_freq
        if freq and c.env_steps // freq > before // freq and c.env_steps < self.config.steps:
            self.evaluate("online", self.config.eval.n_episodes)
        check_room(self.metrics.output_dir)  # while a last checkpoint still fits
        if c.env_steps // self.config.save_freq > before // self.config.save_freq:
            self.person.learning("saving a checkpoint")
            self.save()

    def episode(self) -> None:
        """Act once from reset to end, learn while acting, and store what happened."""
        c, recorder = self.counters, Recorder(self.agent)
        self.agent.reset()
        self.person.expect(c.episodes)
        # The seed follows from the episode's number: a resumed run meets the same scenes.
        frame = self.env.reset(self.config.seed * 100_000 + c.episodes)
        prepared = self.agent.prepare(frame)
        recorder.observe(prepared, frame)
        values: list[float] = []
        ended = False
        try:
            with self._background() as agent:
                while len(recorder) < self.env.max_steps:
                    at_random = c.env_steps < self.config.recipe.random_steps
                    action, q = agent.act(prepared, explore=True, at_random=at_random)
                    outcome = self.env.step(agent.postprocessor(action))
                    executed = agent.carried_out(action, outcome)
                    prepared = agent.prepare(outcome.frame)
                    if outcome.skipped:
                        recorder.retake(prepared, outcome.frame, outcome.reward)
                        agent.retake(first=not len(recorder))
                    else:
                        recorder.step(executed, outcome.reward, taught=outcome.taught)
                        recorder.observe(prepared, outcome.frame)
                        values.append(float(q[0]))
                        c.env_steps += 1
                        self.updates(self.config.recipe.updates_of_steps(c.env_steps - 1, c.env_steps))
                    if self.should_stop():
                        raise Interrupted
                    if outcome.ended:
                        break
                ended = True
        finally:
            if ended:  # also where the learner beside it failed: the person's work is not lost
                with self.spare.given():
                    self._store(recorder, outcome, np.array(values))

    def _store(self, recorder: Recorder, outcome: Outcome, values: NDArray[Any]) -> None:
        """Keep a finished episode and say how it went."""
        c, number = self.counters, self.counters.episodes
        c.episodes += 1
        if not len(recorder):
            self.monitor.message(f"Episode {number} had no step.")
            return
        episode = recorder.episode(terminated=outcome.terminated, success=outcome.success)
        demo = counts_as_demonstration(self.config.recipe, success=outcome.success)
        row = {
            "episode": number, "length": len(episode), "success": int(outcome.success),
            "return": float(episode.reward.sum()), "mean_q": float(values.mean()),
            **describe(Course(states=episode.low_dim, actions=episode.action, values=values), self._shown),
            "taught": sum(recorder.taught), "demonstrations": self.replay.demonstrations + demo, **self._progress(),
        }  # fmt: skip
        if outcome.discarded:
            self._aside = dict([*self._aside.items(), (number, (episode, row))][-SET_ASIDE:])
            self.monitor.message(f"Episode {number} is discarded: nothing is learned from it.")
            return
        self.replay.add(episode, demo=demo, number=number, note=row)
        self.metrics.write("episodes", row)
        self._recent = [*self._recent, outcome.success][-RECENT:]
        lately = f"success {sum(self._recent)}/{len(self._recent)} lately"
        steps = f"step {c.env_steps}  " if self.config.online_minutes is not None else ""
        self.monitor.advance(
            self._online_progress()[2], f"{steps}episode {c.episodes}  {lately}  Q {values.mean():+.2f}"
        )

    def _correct(self) -> None:
        """Learn from now on what a person says otherwise about finished episodes."""
        for number, label in self.person.take_corrected().items():
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

    def _tell_updates(self) -> None:
        self.person.learning(f"update {self.counters.updates}")

    @contextlib.contextmanager
    def _background(self) -> Iterator[Agent]:
        """The agent that acts in an episode: with asynchronous updates a copy, while the original learns beside it."""
        if not self.config.async_updates:
            yield self.agent
            return
        acting = replace(self.agent, policy=deepcopy(self.agent.policy))
        with Background(lambda stop: self.updates(self.config.async_updates, until=stop)):
            yield acting

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
        # By number: an episode that was discarded at first was stored after later ones.
        for place in sorted(places, key=lambda place: place.number):
            self.metrics.write("episodes", place.note)
            before, after = self.counters.env_steps, int(place.note["env_steps"])
            self.counters.episodes, self.counters.env_steps = place.number + 1, after
            owed += recipe.updates_of_steps(before, after) + recipe.updates_of_episode(after)
        if places:
            self.monitor.message(
                f"{len(places)} episodes that ended after the last checkpoint are kept; their {owed} updates are made "
                "again."
            )
        self.updates(owed)

    def evaluate(self, phase: str, episodes: int) -> None:
        """Success rate of the deterministic policy; its random state is kept apart from training's."""
        if not episodes:
            return

        def look() -> None:
            if self.should_stop():
                raise Interrupted

        self.person.expect(None)
        films, seed = self.config.eval.videos, EVAL_SEED if phase == "online" else FINAL_SEED
        result = evaluate(self.agent, self.scenes, episodes, seed=seed, on_step=look, film=films)
        rows = episode_rows(result, self._shown, self.scenes.max_steps)
        if films:
            stem = f"{phase}_{self.counters.env_steps:06d}"
            labels = [f"failure {each['how']}".replace(" ", "_") if each["how"] else "success" for each in rows]
            write_films(result.frames, labels, self.metrics.output_dir / "videos", stem, self.env.fps)
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
