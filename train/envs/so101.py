"""The simulated SO-101 arm of lerobot-env-so101 behind our interface, and its own controller as the operator."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cameras import RENDER_SIZE, make_lean
from .scripted_pauses import Pauses
from .sim_env import MujocoEnv, Observation, box_with_gripper
from .simulator import load_mujoco, needed
from .so101_config import STATE_NAMES, So101SimEnv

__all__ = ["So101Sim", "So101Teleoperator"]

_MOVES = 55  # steps of the package's controller without pauses, about
_STOPS = ("DESCEND", "CLOSE", "LOWER")  # its phases in which a person looks before going on


class So101Sim(MujocoEnv):
    """An SO-101 over a table with a cube, in MuJoCo at 10 Hz; physics, start and success are lerobot-env-so101's own.

    Action, (4,) float32: movement of the point between the jaws along the world's x, y and z, -1 to 1 of `step_size` m
    each, and the jaws, 0 (closed) to 1 (open), absolute. Values out of range are clipped.

    Observation:
        agent_pos: (14,) float32, the package's: 5 joint angles in rad, 5 joint speeds in rad/s, the jaws' command
            (-1 closed, 1 open), the tool's position in m.
        environment_state: float32, positions in m of cube and goal, (6,), or with "pixels" of the goal alone, (3,).
        pixels: the front camera, (image_size, image_size, 3) uint8; not with "state".

    Reward 1 on success (the cube was carried, rests within 3 cm of the goal, and the jaws have let go), which ends the
    episode; else 0. The cube off the table's middle ends it as a failure. `info["is_success"]` is always present.

    Attributes:
        task, task_description: name of the task, and the sentence that instructs it.
        state_names, action_names, environment_state_names: of the numbers above.
    """

    def __init__(self, **settings: Any) -> None:
        """Build the scene from fields of `So101SimEnv`.

        Raises:
            ConfigError: a setting that `So101SimEnv` refuses, or lerobot-env-so101 is missing.
        """
        config = So101SimEnv(**settings)
        self._sim = _simulation(config)
        self._step_size = config.step_size
        make_lean(self._sim.model, config.image_size)
        super().__init__(config, self._sim.model)
        self.task_description = "Put the cube on the goal."
        self.state_names = list(STATE_NAMES)
        self.action_names = ["delta_x", "delta_y", "delta_z", "jaws"]
        self.environment_state_names = [f"{place}.{axis}" for place in config.given_places for axis in "xyz"]
        self.action_space = box_with_gripper(3, 1.0)

    def _begin(self, seed: int | None) -> Observation:
        """Lay the scene out; an episode follows from its seed alone."""
        native, _ = self._sim.reset(seed=int(self.np_random.integers(2**32)))
        return self._observe(native)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 0.1 s.

        Raises:
            DataError: the action is not four finite numbers.
        """
        native, _, terminated, _, info = self._sim.step(self._checked(action).astype(np.float32))
        success = bool(info["succeed"])
        return self._observe(native), float(success), bool(terminated), False, {"is_success": success}

    def render(self) -> NDArray[np.uint8]:
        """The front camera, (360, 480, 3) uint8 RGB."""
        return self._cameras.picture(self._sim.data, "front", *RENDER_SIZE)

    def scripted_teleoperator(self, pause_share: float = 0.0, seed: int = 0) -> "So101Teleoperator":
        """The package's controller as an operator of this environment."""
        return So101Teleoperator(self, pause_share, seed)

    def controller(self) -> Any:
        """A new controller of the package for this environment."""
        from lerobot_env_so101.scripted import PickPlaceController

        return PickPlaceController(self._step_size)

    def places(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Positions of the point between the jaws, of the cube and of the goal, (3,) m each."""
        return self._sim.ik_point_pos, self._sim.data.sensor("block_pos").data, self._sim.goal_pos

    @property
    def opening(self) -> float:
        """The jaws' command, 0 (closed) to 1 (open)."""
        return (float(self._sim.get_gripper_pose()[0]) + 1.0) / 2.0

    def _observe(self, native: dict[str, Any]) -> Observation:
        places = native["environment_state"][-len(self.environment_state_names) :]
        observation: Observation = {"agent_pos": native["agent_pos"], "environment_state": places}
        if self._camera_names:
            observation["pixels"] = self._pictures(self._sim.data)
        return observation


class So101Teleoperator:
    """Operator that steers by the package's controller and pauses, as a person does: at the start, above the cube,
    before the jaws close, above the goal, and at random. While pausing it sends no movement, the jaws as they were.

    Attributes:
        pausing: whether the last `act` was a pause.
    """

    pausing: bool

    def __init__(self, env: So101Sim, pause_share: float, seed: int) -> None:
        """Steer `env` (unwrapped). Raises ConfigError where `pause_share` is not 0 to 0.9."""
        self._env, self._controller = env, env.controller()
        self._pauses = Pauses(pause_share, 1 + len(_STOPS), _MOVES)
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Begin an episode; call it after the environment's reset. The same seed gives the same pauses."""
        self._controller.reset()
        self._pauses.reset(np.random.default_rng(seed))
        self.pausing = False

    def act(self) -> NDArray[np.float32]:
        """Action for the present state, (4,) float32 within the action space."""
        phase = self._controller.phase.name
        self.pausing = self._pauses.next((phase,) if phase in _STOPS else ())
        if self.pausing:
            return np.array([0.0, 0.0, 0.0, self._env.opening], np.float32)
        action: NDArray[np.float32] = self._controller.act(*self._env.places())
        return action


def _simulation(config: So101SimEnv) -> Any:
    """The package's environment. Raises ConfigError where it is not installed."""
    with needed("The environment 'so101_sim' needs lerobot-env-so101", "so101"):
        load_mujoco()
        from lerobot_env_so101 import SO101PickPlaceGymEnv
    return SO101PickPlaceGymEnv(random_block_position=config.random_position, action_scale=config.step_size)
