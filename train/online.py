"""The loop: offline updates on the demonstrations, then acting and learning (Algorithm 2)."""

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from lerobot_cqn.learner import Learner, NonFiniteLossError
from lerobot_cqn.schema import Batch

from .agent import Agent, Recorder
from .checkpoint import Counters
from .config import RunConfig
from .evaluate import Evaluation, evaluate
from .interfaces import Environment, Scenes
from .look import save_batch, write_films
from .metrics import Metrics
from .replay import Replay
from .storage import Place

__all__ = ["Interrupted", "Monitor", "Trainer"]

RECENT = 20  # training episodes in the progress line


class Interrupted(Exception):  # noqa: N818  # a request, not an error
    """The person asked to stop; the trainer is in a state that can be saved."""


class Monitor(Protocol):
    """What a person sees while it runs."""

    def phase(self, name: str, total: int, done: int) -> None:
        """A phase of `total` units begins, `done` of them already behind."""
        ...

    def advance(self, done: int, note: str) -> None:
        """Progress within the phase."""
        ...

    def message(self, text: str) -> None:
        """A line that stays."""
        ...


@dataclass
class Trainer:
    """Everything the loop touches; made by `cli.py`, the only composition root."""

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
    evaluations: list[tuple[str, Evaluation]] = field(default_factory=list)
    finished_since: Sequence[Place] = ()
    _recent: list[bool] = field(default_factory=list)
    _clock: float = field(default_factory=time.monotonic)

    def run(self) -> None:
        """Offline phase, online phase, final evaluation. Raises Interrupted between two updates or steps."""
        self.take_up(self.finished_since)
        if not self.counters.offline_done:
            self._offline()
        self._online()
        self.evaluate("final", self.config.eval.final_n_episodes)
        self.save()

    def close(self) -> None:
        """Free the simulators."""
        self.scenes.close()
        self.env.close()

    def _offline(self) -> None:
        total = self.config.offline_updates
        self.monitor.phase("offline", total, self.counters.updates)
        self.updates(total - self.counters.updates, on_update=lambda: self.monitor.advance(self.counters.updates, ""))
        if total and self.config.steps:
            self.evaluate("offline", self.config.eval.final_n_episodes)
        self.counters.offline_done = True
        self.save()

    def _online(self) -> None:
        c, freq = self.counters, self.config.eval.freq
        self.monitor.phase("online", self.config.steps, c.env_steps)
        while c.env_steps < self.config.steps:
            before = c.env_steps
            try:
                self.episode()
            except Interrupted:  # the unfinished episode is dropped, so its steps do not count either
                c.env_steps = before
                raise
            self.updates(self.config.recipe.updates_per_episode)
            if freq and c.env_steps // freq > before // freq and c.env_steps < self.config.steps:
                self.evaluate("online", self.config.eval.n_episodes)
            if c.env_steps // self.config.save_freq > before // self.config.save_freq:
                self.save()

    def episode(self) -> None:
        """Act once from reset to end, learn while acting, and store what happened."""
        c, recorder = self.counters, Recorder(self.agent)
        self.agent.policy.reset()
        # The seed follows from the episode's number: a resumed run meets the same scenes.
        prepared = self.agent.prepare(self.env.reset(self.config.seed * 100_000 + c.episodes))
        recorder.observe(prepared)
        q_values: list[float] = []
        for _ in range(self.env.max_steps):
            action, q = self.agent.act(prepared, explore=True)
            outcome = self.env.step(self.agent.postprocessor(action))
            recorder.step(action, outcome.reward)
            prepared = self.agent.prepare(outcome.frame)
            recorder.observe(prepared)
            q_values.append(q)
            c.env_steps += 1
            self.updates(self.config.recipe.updates_per_step)
            if self.should_stop():
                raise Interrupted
            if outcome.terminated or outcome.truncated:
                break
        episode = recorder.episode(terminated=outcome.terminated, success=outcome.success)
        demo = self.config.recipe.relabel and outcome.success
        row = {
            "episode": c.episodes, "length": len(episode), "success": int(outcome.success),
            "return": float(episode.reward.sum()), "mean_q": float(np.mean(q_values)),
            "demonstrations": self.replay.demonstrations + demo, **self._progress(),
        }  # fmt: skip
        self.replay.add(episode, demo=demo, number=c.episodes, note=row)
        c.episodes += 1
        self.metrics.write("episodes", row)
        self._recent = [*self._recent, outcome.success][-RECENT:]
        lately = f"success {sum(self._recent)}/{len(self._recent)} lately"
        self.monitor.advance(c.env_steps, f"episode {c.episodes}  {lately}  Q {row['mean_q']:+.2f}")

    def updates(self, count: int, on_update: Callable[[], None] = lambda: None) -> None:
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
        for place in places:
            self.metrics.write("episodes", place.note)
            self.counters.episodes, self.counters.env_steps = place.number + 1, int(place.note["env_steps"])
            owed += place.length * recipe.updates_per_step + recipe.updates_per_episode
        if places:
            self.monitor.message(
                f"{len(places)} episodes that ended after the last checkpoint are kept; their {owed} updates are made "
                "again."
            )
        self.updates(owed)

    def evaluate(self, phase: str, episodes: int) -> None:
        """Success rate of the deterministic policy; its random state is kept apart from training's."""

        def look(_: int) -> None:
            if self.should_stop():
                raise Interrupted

        films = self.config.eval.videos
        result = evaluate(self.agent, self.scenes, episodes, on_episode=look, film=films)
        if films:
            stem = f"{phase}_{self.counters.env_steps:06d}"
            write_films(result.frames, result.outcomes, self.metrics.output_dir / "videos", stem, self.env.fps)
        self.evaluations.append((phase, result))
        low, high = result.interval
        row = {
            "phase": phase, "episodes": self.counters.episodes, "n": result.n, "successes": result.successes,
            "success_rate": result.success_rate, "ci_low": low, "ci_high": high,
            "mean_length": float(np.mean(result.steps)), "mean_return": result.mean_return,
        }  # fmt: skip
        self.metrics.write("evaluations", row | self._progress())
        self.monitor.message(f"{phase:>8}  step {self.counters.env_steps:>6}  {result}")

    def _progress(self) -> dict[str, float]:
        now = time.monotonic()
        self.counters.wall_s += now - self._clock
        self._clock = now
        c = self.counters
        return {"env_steps": c.env_steps, "updates": c.updates, "wall_s": round(c.wall_s, 2)}
