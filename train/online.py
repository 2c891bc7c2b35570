"""The loop: offline updates on the demonstrations, then acting and learning (Algorithm 2)."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from lerobot_cqn.learner import Learner

from .agent import Agent, Recorder
from .checkpoint import Counters
from .config import RunConfig
from .evaluate import Evaluation, evaluate
from .interfaces import Environment
from .metrics import Metrics
from .replay import Replay

__all__ = ["Interrupted", "Monitor", "Trainer"]


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
    replay: Replay
    metrics: Metrics
    monitor: Monitor
    rng: np.random.Generator
    counters: Counters
    save: Callable[[], None]
    should_stop: Callable[[], bool]
    evaluations: list[tuple[str, Evaluation]] = field(default_factory=list)
    _clock: float = field(default_factory=time.monotonic)

    def run(self) -> None:
        """Offline phase, online phase, final evaluation. Raises Interrupted between two updates or steps."""
        if not self.counters.offline_done:
            self._offline()
        self._online()
        self.evaluate("final", self.config.eval.final_n_episodes)
        self.save()

    def _offline(self) -> None:
        total = self.config.offline_updates
        self.monitor.phase("offline", total, self.counters.updates)
        while self.counters.updates < total:
            self.update()
            self.monitor.advance(self.counters.updates, "")
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
            for _ in range(self.config.schedule["updates_per_episode"]):
                self.update()
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
            for _ in range(self.config.schedule["updates_per_step"]):
                self.update()
            if self.should_stop():
                raise Interrupted
            if outcome.terminated or outcome.truncated:
                break
        episode = recorder.episode(terminated=outcome.terminated, success=outcome.success)
        self.replay.add(episode, demo=self.config.relabel and outcome.success)
        row = {
            "episode": c.episodes, "length": len(episode), "success": int(outcome.success),
            "return": float(episode.reward.sum()), "mean_q": float(np.mean(q_values)),
            "demonstrations": self.replay.demonstrations,
        }  # fmt: skip
        c.episodes += 1
        self.metrics.write("episodes", row | self._progress())
        self.monitor.advance(c.env_steps, f"episode {c.episodes}  Q {row['mean_q']:+.2f}")

    def update(self) -> None:
        """One gradient update on a batch from both stores."""
        schedule = self.config.schedule
        batch = self.replay.sample(schedule["batch_size"], schedule["demo_batch_size"], self.rng)
        stats = self.learner.update(batch)
        self.counters.updates += 1
        if self.counters.updates % self.config.log_freq == 0:
            self.metrics.write("updates", {name: float(value) for name, value in stats.items()} | self._progress())
        if self.should_stop():
            raise Interrupted

    def evaluate(self, phase: str, episodes: int) -> None:
        """Success rate of the deterministic policy; its random state is kept apart from training's."""

        def look(_: int) -> None:
            if self.should_stop():
                raise Interrupted

        result = evaluate(self.agent, self.env, episodes, on_episode=look)
        self.evaluations.append((phase, result))
        low, high = result.interval
        row = {
            "phase": phase, "episodes": self.counters.episodes, "n": result.n, "successes": result.successes,
            "success_rate": result.success_rate, "ci_low": low, "ci_high": high,
            "mean_length": float(np.mean(result.steps)),
        }  # fmt: skip
        self.metrics.write("evaluations", row | self._progress())
        self.monitor.message(f"{phase:>8}  step {self.counters.env_steps:>6}  success {result}")

    def _progress(self) -> dict[str, float]:
        now = time.monotonic()
        self.counters.wall_s += now - self._clock
        self._clock = now
        c = self.counters
        return {"env_steps": c.env_steps, "updates": c.updates, "wall_s": round(c.wall_s, 2)}
