"""Success rate of the deterministic policy over fresh episodes, with its 95 % interval."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import sqrt
from typing import Any

from numpy.typing import NDArray

from .agent import Agent
from .interfaces import Environment

__all__ = ["EVAL_SEED", "Evaluation", "evaluate", "wilson_interval"]

# Far from the seeds of training episodes (seed * 100,000 + episode), and the same for every run: variants are compared
# on equal episodes.
EVAL_SEED = 2_147_000_000


@dataclass(frozen=True)
class Evaluation:
    """What evaluation episodes came to; steps: their lengths; frames: pictures of the first episodes."""

    outcomes: list[bool]
    steps: list[int]
    frames: list[list[NDArray[Any]]] = field(default_factory=list)

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
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the success rate."""
        return wilson_interval(self.successes, self.n)

    def __str__(self) -> str:
        """For a person: rate, n and interval."""
        low, high = self.interval
        return f"{self.success_rate:.2f} (n={self.n}, 95 % {low:.2f}-{high:.2f})"


def wilson_interval(successes: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a proportion; honest at 0 and 1 and for small n."""
    p = successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return max(0.0, centre - half), min(1.0, centre + half)


def evaluate(
    agent: Agent,
    env: Environment,
    episodes: int,
    *,
    seed: int = EVAL_SEED,
    on_episode: Callable[[int], None] = lambda _: None,
    film: int = 0,
) -> Evaluation:
    """Run `episodes` episodes without noise, as lerobot-eval does. film: episodes to take pictures of."""
    outcomes, steps, films = [], [], []
    for index in range(episodes):
        agent.policy.reset()
        frame, film_frames = env.reset(seed + index), []
        for count in range(1, env.max_steps + 1):  # noqa: B007  # read after the loop
            if index < film:
                film_frames.append(env.render())
            action, _ = agent.act(agent.prepare(frame), explore=False)
            outcome = env.step(agent.postprocessor(action))
            frame = outcome.frame
            if outcome.success or outcome.terminated or outcome.truncated:
                break
        if index < film:
            films.append([*film_frames, env.render()])
        outcomes.append(outcome.success)
        steps.append(count)
        on_episode(index + 1)
    return Evaluation(outcomes, steps, films)
