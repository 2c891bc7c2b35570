"""Success rate of the deterministic policy over fresh episodes, with its 95 % interval."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..agent import Agent
from ..interfaces import Scenes
from ..replay.course import Course, Shown, describe

__all__ = ["EVAL_SEED", "FINAL_SEED", "Evaluation", "evaluate", "wilson_interval"]

# Far from the seeds of training episodes (seed * 100,000 + episode), and the same for every run: variants are compared
# on equal episodes.
EVAL_SEED = 2_147_000_000
# Before and after practice, on the same scenes, which no evaluation on the way has: choosing by those flatters nothing.
FINAL_SEED = EVAL_SEED + 200_000


@dataclass(frozen=True)
class Evaluation:
    """Result of evaluation episodes.

    outcomes: success; steps: lengths; returns: sums of rewards; courses: what the policy saw and did, all episodes
    alike; frames: pictures of the first episodes.
    """

    outcomes: list[bool] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    courses: list[Course] = field(default_factory=list)
    frames: list[list[NDArray[Any]]] = field(default_factory=list)

    @classmethod
    def together(cls, parts: Sequence["Evaluation"], episodes: int) -> "Evaluation":
        """Evaluations of some episodes each as one of the first `episodes`."""
        names = [one.name for one in fields(cls)]
        return cls(**{name: [one for part in parts for one in getattr(part, name)][:episodes] for name in names})

    @property
    def n(self) -> int:
        """Episodes."""
        return len(self.outcomes)

    @property
    def successes(self) -> int:
        """Successful episodes."""
        return sum(self.outcomes)

    @property
    def success_rate(self) -> float:
        """Share of successful episodes."""
        return self.successes / self.n

    @property
    def mean_return(self) -> float:
        """Mean sum of rewards of an episode."""
        return float(np.mean(self.returns))

    @property
    def standing_failures(self) -> float | None:
        """Share of the steps of failed episodes in which nothing moved; None where none failed or there is no state."""
        failed = [(self.steps[i], describe(self.courses[i], Shown())) for i, ok in enumerate(self.outcomes) if not ok]
        stood = [(steps, said["standing"]) for steps, said in failed if said["standing"] is not None]
        return sum(steps * share for steps, share in stood) / sum(steps for steps, _ in stood) if stood else None

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the success rate."""
        return wilson_interval(self.successes, self.n)

    def __str__(self) -> str:
        """For a person: success rate, n and interval; the return where rewards are more than successes."""
        low, high = self.interval
        success = f"success {self.success_rate:.2f} (n={self.n}, 95 % {low:.2f}-{high:.2f})"
        if abs(self.mean_return - self.success_rate) < 1e-6:
            return success
        returned = f"return {self.mean_return:.3g} (n={self.n})"
        return f"{returned}  {success}" if self.successes else returned


def wilson_interval(successes: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a proportion; honest at 0 and 1 and for small n."""
    p = successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return max(0.0, centre - half), min(1.0, centre + half)


def evaluate(
    agent: Agent,
    scenes: Scenes,
    episodes: int,
    *,
    seed: int = EVAL_SEED,
    on_step: Callable[[], None] = lambda: None,
    film: int = 0,
) -> Evaluation:
    """Run `episodes` episodes without noise, as lerobot-eval does, as many at a time as there are scenes.

    on_step: called before each control step; what it raises ends the evaluation. film: episodes to take pictures of.
    Episode i has seed + i, however many run at a time.
    """
    waves = [
        _wave(agent, scenes, seed + first, max(0, film - first), on_step) for first in range(0, episodes, scenes.count)
    ]
    return Evaluation.together(waves, episodes)


def _wave(agent: Agent, scenes: Scenes, seed: int, film: int, on_step: Callable[[], None]) -> Evaluation:
    """One episode in each scene, with pictures of the first `film`."""
    agent.reset()
    count = scenes.count
    frame = scenes.reset([seed + k for k in range(count)])
    running, success = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
    length, total = np.zeros(count, dtype=int), np.zeros(count)
    films: list[list[NDArray[Any]]] = [[] for _ in range(min(film, count))]
    taken: list[tuple[NDArray[np.bool_], NDArray[Any] | None, NDArray[Any], NDArray[Any]]] = []

    def look() -> None:
        pictures = scenes.render() if running[: len(films)].any() else []
        for k, shown in enumerate(films):
            if running[k]:
                shown.append(pictures[k])

    while running.any() and length.max() < scenes.max_steps:
        on_step()
        look()
        prepared = agent.prepare(frame)
        action, value = agent.act(prepared, explore=False)
        outcome = scenes.step(agent.postprocessor(action))
        frame = outcome.frame
        if outcome.skipped:
            agent.retake(first=not length.any())
        else:
            taken.append((running.copy(), agent.low_dim(prepared), action.cpu().numpy(), value))
        length += running & (not outcome.skipped)
        total += np.where(running, outcome.reward, 0.0)
        success |= running & outcome.success
        running &= ~outcome.ended
    # The last picture of an episode that ends together with the others; one that ended before has begun anew.
    if count == 1 and films:
        films[0].append(scenes.render()[0])
    courses = [_course([row for row in taken if row[0][k]], k) for k in range(count)]
    return Evaluation(success.tolist(), length.tolist(), total.tolist(), courses, films)


def _course(taken: Sequence[tuple[Any, NDArray[Any] | None, NDArray[Any], NDArray[Any]]], scene: int) -> Course:
    """What was seen and done in the steps of one scene."""
    states = [state[scene] for _, state, _, _ in taken if state is not None]
    return Course(
        states=np.stack(states) if states else None,
        actions=np.array([action[scene] for _, _, action, _ in taken]).reshape(len(taken), -1),
        values=np.array([value[scene] for *_, value in taken]),
    )
