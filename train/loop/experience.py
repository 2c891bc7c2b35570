"""Where a run's episodes and evaluations come from, as the trainer sees it; here: from this process."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from ..agent import Agent
from ..interfaces import Environment, Label, Nobody, Person, Scenes
from .acting import Acting, Finished, Turn
from .evaluate import Evaluation, evaluate

__all__ = ["Experience", "Here", "Turns"]

# Makes the next turn, where so many control steps are done and wait to be stored; None: the run has enough.
Turns = Callable[[int], Turn | None]


class Experience(Protocol):
    """Source of episodes for the learner."""

    @property
    def fps(self) -> int:
        """Control steps a second."""
        ...

    @property
    def max_steps(self) -> int:
        """Control steps before an evaluation episode is cut off."""
        ...

    @property
    def waited_s(self) -> float:
        """Seconds so far in which a person was waited for."""
        ...

    def open(self, known: Collection[str]) -> None:
        """Get ready; called once, before the first episode. known: keys of turns whose episodes are stored already."""
        ...

    def collect(self, agent: Agent, next_turn: Turns, on_step: Callable[[int], None]) -> Finished:
        """The next episode that is over, acted by `agent` or by copies of it that may be older.

        next_turn: makes a turn; on_step: told the control steps of the run when an episode begins and after each step
        that learning may follow at once. Raises Interrupted when the person wants no more.
        """
        ...

    @property
    def note(self) -> str:
        """What a person may want to know of how acting and learning keep up with one another; "" for nothing."""
        ...

    def tend(self, agent: Agent, next_turn: Turns, owed: int) -> None:
        """Look after what goes on elsewhere, between two updates of which `owed` are left."""
        ...

    def evaluate(self, agent: Agent, episodes: int, seed: int, on_step: Callable[[], None], film: int) -> Evaluation:
        """Result of `episodes` evaluation episodes (`loop.evaluate.evaluate`)."""
        ...

    def rest(self) -> Sequence[Finished]:
        """Episodes that were under way elsewhere when the run had enough; waits for their ends."""
        ...

    def stored(self, finished: Finished) -> None:
        """Say that an episode is kept for good, so that nobody else needs to keep it."""
        ...

    def learning(self, doing: str) -> None:
        """Say what the learner is at."""
        ...

    def take_corrected(self) -> Mapping[int, Label]:
        """Labels of finished episodes, by number, that a person changed since the last call."""
        ...


@dataclass(kw_only=True)
class Here:
    """One environment in this process, with its person, and what evaluates."""

    env: Environment
    scenes: Scenes
    person: Person
    random_steps: int = 0

    @classmethod
    def alone(cls, env: Environment, scenes: Scenes, random_steps: int = 0) -> "Here":
        """An environment that judges for itself."""
        return cls(env=env, scenes=scenes, person=Nobody(), random_steps=random_steps)

    @property
    def fps(self) -> int:
        """Control steps a second."""
        return self.env.fps

    @property
    def max_steps(self) -> int:
        """Control steps before an evaluation episode is cut off."""
        return self.scenes.max_steps

    @property
    def waited_s(self) -> float:
        """Seconds so far in which a person was waited for."""
        return self.env.waited_s

    def open(self, known: Collection[str]) -> None:
        """Get ready."""
        del known
        self.env.open()

    def collect(self, agent: Agent, next_turn: Turns, on_step: Callable[[int], None]) -> Finished:
        """Act an episode from reset to end."""
        turn = next_turn(0)
        assert turn is not None  # noqa: S101  # the trainer asks only where it wants one
        acting = Acting(turn, agent, self.env, self.person, self.random_steps)
        for steps in acting:
            on_step(steps)
        assert acting.finished is not None  # noqa: S101  # it came to its end
        return acting.finished

    @property
    def note(self) -> str:
        """Nothing: they take turns."""
        return ""

    def tend(self, agent: Agent, next_turn: Turns, owed: int) -> None:
        """Nothing: nothing goes on elsewhere."""
        del agent, next_turn, owed

    def evaluate(self, agent: Agent, episodes: int, seed: int, on_step: Callable[[], None], film: int) -> Evaluation:
        """Evaluate in this process."""
        self.person.expect(None)
        return evaluate(agent, self.scenes, episodes, seed=seed, on_step=on_step, film=film)

    def rest(self) -> Sequence[Finished]:
        """None: nothing is under way elsewhere."""
        return ()

    def stored(self, finished: Finished) -> None:
        """Nothing: nobody else has it."""
        del finished

    def learning(self, doing: str) -> None:
        """Tell the person."""
        self.person.learning(doing)

    def take_corrected(self) -> Mapping[int, Label]:
        """What the person says otherwise."""
        return self.person.take_corrected()
