"""One episode in an environment, from reset to end, step by step: in the process that learns, or in another one."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..agent import Agent
from ..interfaces import Environment, Outcome, Person
from ..replay.episode import Episode
from ..replay.recorder import Recorder

__all__ = ["Acting", "Finished", "Turn"]


@dataclass(frozen=True, kw_only=True)
class Turn:
    """An episode that is to be acted.

    number: of the episode in the run; seed: of its scene; steps: control steps of the run before it; key: what tells
    it from every other turn, of resumed runs too, "" where nobody could take it for another.
    """

    number: int
    seed: int
    steps: int
    key: str = ""


@dataclass(frozen=True, kw_only=True)
class Finished:
    """An episode that is over. episode: None where it had no step; values: mean Q of its actions, [T]."""

    turn: Turn
    episode: Episode | None
    success: bool
    discarded: bool
    values: NDArray[np.float64]

    @property
    def steps(self) -> int:
        """T."""
        return len(self.values)


class Acting:
    """Acts a turn: iterate, the start and each control step yield how many the run has had; then it is `finished`.

    What its user does in between (learning, say) happens between two steps, before the next action is chosen.
    """

    def __init__(self, turn: Turn, agent: Agent, env: Environment, person: Person, random_steps: int) -> None:
        """Nothing happens yet. random_steps: control steps of the run that are uniform actions."""
        self.turn, self.agent, self.env, self.person = turn, agent, env, person
        self.random_steps = random_steps
        self.finished: Finished | None = None

    def __iter__(self) -> Iterator[int]:
        agent, recorder, values = self.agent, Recorder(self.agent), list[float]()
        agent.reset()
        self.person.expect(self.turn.number)
        frame = self.env.reset(self.turn.seed)
        prepared = agent.prepare(frame)
        recorder.observe(prepared, frame)
        outcome: Outcome | None = None
        yield self.turn.steps
        while len(recorder) < self.env.max_steps and not (outcome and outcome.ended):
            at_random = self.turn.steps + len(recorder) < self.random_steps
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
            yield self.turn.steps + len(recorder)
        assert outcome is not None  # noqa: S101  # max_steps is at least 1
        self.finished = Finished(
            turn=self.turn,
            episode=recorder.episode(terminated=outcome.terminated, success=outcome.success) if values else None,
            success=outcome.success,
            discarded=outcome.discarded,
            values=np.array(values),
        )
