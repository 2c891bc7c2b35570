"""What there is to do at the virtual SO-101's table: things, where they lie, when it is done, how a person does it."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["TASKS", "Move", "TableTask"]

Array = NDArray[np.float64]

CLOSED, HOLDING, OPEN = -0.1, 0.25, 0.9  # rad of the jaws
ABOVE_M = 0.05  # over what is to be touched


@dataclass(frozen=True, kw_only=True)
class Move:
    """Something that a person does next.

    Attributes:
        place: (3,) m, of the task's point at the jaws; jaws: rad.
        seconds: that it takes, about; hesitates: whether a person may look before it.
    """

    place: Array
    jaws: float
    seconds: float
    hesitates: bool = False


def up(metres: float) -> Array:
    """(3,) m straight up."""
    return np.array([0.0, 0.0, metres])


class TableTask(ABC):
    """A task; spread_m: how far from the middle its things are laid, m; None: as usual.

    Attributes:
        sentence: that instructs it; usual_m: the usual spread.
        grasps: whether the point that does it is the middle between the jaws; else it is the fixed jaw's tip.
    """

    sentence: ClassVar[str]
    usual_m: ClassVar[float]
    grasps: ClassVar[bool] = False

    def __init__(self, spread_m: float | None) -> None:
        self.spread_m = self.usual_m if spread_m is None else spread_m

    @abstractmethod
    def build(self, mujoco: Any, spec: Any) -> None:
        """Add the things to a scene."""

    @abstractmethod
    def lay_out(self, model: Any, data: Any, rng: np.random.Generator) -> None:
        """Put them where they are in a new scene."""

    @abstractmethod
    def done(self, model: Any, data: Any) -> bool:
        """Whether it is done now."""

    @abstractmethod
    def moves(self, data: Any) -> list[Move]:
        """What a person does from home on."""

    def _near(self, middle: tuple[float, float], rng: np.random.Generator) -> Array:
        return np.array(middle) + rng.uniform(-self.spread_m, self.spread_m, 2)


class PressButton(TableTask):
    """A red button, to be pressed by 4 mm."""

    sentence = "Press the red button."
    usual_m = 0.02

    def build(self, mujoco: Any, spec: Any) -> None:
        """A box that stands on the table, with a cap on a spring."""
        kinds = mujoco.mjtGeom
        box = spec.worldbody.add_body(name="button")
        box.add_geom(type=kinds.mjGEOM_BOX, size=[0.025, 0.025, 0.006], pos=[0, 0, 0.006], rgba=[0.2, 0.2, 0.22, 1.0])
        cap = box.add_body(name="cap", pos=[0, 0, 0.02])
        cap.add_joint(
            name="cap", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], range=[-0.008, 0.0], limited=True,
            stiffness=60.0, damping=1.0, springref=0.002,
        )  # fmt: skip
        spec.add_exclude(bodyname1="button", bodyname2="cap")  # it goes into the box
        cap.add_geom(type=kinds.mjGEOM_CYLINDER, size=[0.016, 0.008, 0], mass=0.01, rgba=[0.85, 0.1, 0.1, 1.0])

    def lay_out(self, model: Any, data: Any, rng: np.random.Generator) -> None:
        """The box anywhere in a square."""
        model.body("button").pos[:2] = self._near((0.25, 0.0), rng)
        data.joint("cap").qpos[:] = data.joint("cap").qvel[:] = 0.0

    def done(self, model: Any, data: Any) -> bool:
        """Whether the cap is down."""
        return bool(data.joint("cap").qpos[0] < -0.004)

    def moves(self, data: Any) -> list[Move]:
        """Over it, down, and up again."""
        top = data.body("cap").xpos + up(0.008)
        above, pressed = top + up(ABOVE_M), top - up(0.012)
        return [
            Move(place=above, jaws=CLOSED, seconds=1.5, hesitates=True),
            Move(place=pressed, jaws=CLOSED, seconds=1.0, hesitates=True),
            Move(place=above, jaws=CLOSED, seconds=0.8),
        ]


class CubeInBowl(TableTask):
    """A cube of 3.6 cm, to be put into a bowl of 13 cm and let go."""

    sentence = "Put the cube into the bowl."
    usual_m = 0.02
    grasps = True
    half_m, wide_m = 0.018, 0.065

    def build(self, mujoco: Any, spec: Any) -> None:
        """The cube lies free; the bowl is a ring of eight walls that stays where it is."""
        kinds = mujoco.mjtGeom
        cube = spec.worldbody.add_body(name="cube")
        cube.add_freejoint(name="cube")
        cube.add_geom(
            type=kinds.mjGEOM_BOX, size=[self.half_m] * 3, mass=0.02, friction=[1.5, 0.01, 0.001],
            rgba=[0.15, 0.4, 0.8, 1.0],
        )  # fmt: skip
        bowl = spec.worldbody.add_body(name="bowl")
        for turn in np.arange(8) * np.pi / 4:
            bowl.add_geom(
                type=kinds.mjGEOM_BOX, size=[0.003, 0.028, 0.012], rgba=[0.95, 0.95, 0.9, 1.0],
                pos=[self.wide_m * np.cos(turn), self.wide_m * np.sin(turn), 0.012],
                quat=[np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)],
            )  # fmt: skip

    def lay_out(self, model: Any, data: Any, rng: np.random.Generator) -> None:
        """Both anywhere in a square each."""
        data.joint("cube").qpos[:] = [*self._near((0.25, -0.04), rng), self.half_m, 1.0, 0.0, 0.0, 0.0]
        data.joint("cube").qvel[:] = 0.0
        model.body("bowl").pos[:2] = self._near((0.2, 0.15), rng)

    def done(self, model: Any, data: Any) -> bool:
        """Whether the cube lies in the bowl, and nothing but table and bowl touches it."""
        cube = data.joint("cube").qpos[:3]
        inside = float(np.linalg.norm(cube[:2] - model.body("bowl").pos[:2])) < self.wide_m - self.half_m
        return inside and cube[2] < 2 * self.half_m and not self._held(model, data)

    def moves(self, data: Any) -> list[Move]:
        """To the cube, close, up, over to the bowl, and let go."""
        cube, bowl = data.joint("cube").qpos[:3].copy(), data.body("bowl").xpos.copy()
        lifted, over = cube + up(ABOVE_M), bowl + up(0.06)
        return [
            Move(place=lifted, jaws=OPEN, seconds=1.5, hesitates=True),
            Move(place=cube, jaws=OPEN, seconds=1.0, hesitates=True),
            Move(place=cube, jaws=HOLDING, seconds=0.6),
            Move(place=lifted, jaws=HOLDING, seconds=0.8),
            Move(place=over, jaws=HOLDING, seconds=1.5, hesitates=True),
            Move(place=over, jaws=OPEN, seconds=0.6),
        ]

    @staticmethod
    def _held(model: Any, data: Any) -> bool:
        cube, still = model.body("cube").id, {0, model.body("bowl").id}
        pairs = model.geom_bodyid[data.contact.geom]
        return any(cube in pair and not (set(pair) - {cube}) <= still for pair in pairs.tolist())


TASKS: dict[str, type[TableTask]] = {"press_button": PressButton, "cube_in_bowl": CubeInBowl}
