"""gym_hil's simulated Franka arm, seeded and without its expensive renderer."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cameras import RENDER_SIZE, make_lean
from .hil_config import STATE_NAMES, STEP, TASKS, HilSimEnv
from .hil_expert import HilTeleoperator
from .sim_env import MujocoEnv, Observation, box_with_gripper, preserved_numpy_random
from .simulator import load_mujoco, needed

__all__ = ["HilSim"]

_IN_MODEL = {"wrist": "handcam_rgb"}  # our name of a camera, and gym_hil's
_CLOSED = 255.0  # gym_hil's gripper command


class HilSim(MujocoEnv):
    """gym_hil's Franka Panda with a gripper over a floor, in MuJoCo at 10 Hz; sparse reward.

    Its physics, controller, start and success are gym_hil's own; only seeding, pictures and the gripper's convention
    are ours.

    Action, (4,) float32: movement of the tool's target along the world's x, y and z, -1 to 1 of 2.5 cm each, and the
    gripper, 0 (open) to 1 (closed), absolute. Values out of range are clipped.

    Observation:
        agent_pos: (18,) float32, gym_hil's: 7 joint angles in rad, 7 joint speeds in rad/s, the gripper's command
            (0 open, 255 closed), the tool's position in m.
        environment_state: (3,) float32 an object, its position in m; not with "pixels".
        pixels: one (image_size, image_size, 3) uint8 a camera; not with "state".

    Reward 1 on success (the cube 10 cm up; all boxes within 3 cm of their fields), which ends the episode; else 0.
    The cube pushed off the floor's middle ends it as a failure. `info["is_success"]` is always present.

    Attributes:
        task, task_description: name of the task, and the sentence that instructs it.
        state_names, action_names, environment_state_names: of the numbers above.
        objects: names of the movable objects.
    """

    def __init__(self, **settings: Any) -> None:
        """Build the scene from fields of `HilSimEnv`.

        Raises:
            ConfigError: a setting that `HilSimEnv` refuses, or gym_hil is missing.
        """
        config = HilSimEnv(**settings)
        task = TASKS[str(config.task)]
        self._sim = _simulation(task.simulation, config)
        make_lean(self._sim.model, config.image_size)
        super().__init__(config, self._sim.model)
        self.objects = task.objects
        self.task_description = task.description
        self.state_names = list(STATE_NAMES)
        self.action_names = ["delta_x", "delta_y", "delta_z", "gripper"]
        self.environment_state_names = [f"{name}.{axis}" for name in self.objects for axis in "xyz"]
        self.action_space = box_with_gripper(3, 1.0)

    def _begin(self, seed: int | None) -> Observation:
        """Lay the scene out; an episode follows from its seed alone."""
        # gym_hil ignores a seed and draws from numpy's global state.
        with preserved_numpy_random(int(self.np_random.integers(2**32))):
            self._sim.reset()
        return self._observe()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 0.1 s.

        Raises:
            DataError: the action is not four finite numbers.
        """
        checked = self._checked(action)
        # gym_hil's own action is a change of the gripper's closure.
        native = np.concatenate([checked[:3] * STEP, np.zeros(3), [checked[3] - self.closure]])
        _, reward, terminated, _, _ = self._sim.step(native)
        success = bool(reward == 1.0)
        return self._observe(), float(success), bool(terminated), False, {"is_success": success}

    def render(self) -> NDArray[np.uint8]:
        """The front camera, (360, 480, 3) uint8 RGB."""
        return self._cameras.picture(self._sim.data, "front", *RENDER_SIZE)

    def scripted_teleoperator(self, pause_share: float = 0.0, seed: int = 0) -> HilTeleoperator:
        """A scripted operator for this environment."""
        return HilTeleoperator(self, pause_share=pause_share, seed=seed)

    # -- what the scripted operator sees ----------------------------------------------------------------------

    @property
    def closure(self) -> float:
        """The gripper's command, 0 (open) to 1 (closed)."""
        return float(self._sim.get_gripper_pose()[0]) / _CLOSED

    @property
    def tip(self) -> NDArray[np.float64]:
        """Measured position of the tool, (3,) m."""
        return self.place("2f85/pinch")

    @property
    def target(self) -> NDArray[np.float64]:
        """Position the tool is sent to, (3,) m."""
        target: NDArray[np.float64] = self._sim.data.mocap_pos[0].copy()
        return target

    def place(self, name: str) -> NDArray[np.float64]:
        """Position of an object or field, (3,) m."""
        position: NDArray[np.float64] = self._sim.data.sensor(f"{name}_pos").data.copy()
        return position

    # -- inside -----------------------------------------------------------------------------------------------

    def _observe(self) -> Observation:
        observation: Observation = {"agent_pos": self._sim.get_robot_state().astype(np.float32)}
        if self._with_state:
            places = np.concatenate([self.place(name) for name in self.objects])
            observation["environment_state"] = places.astype(np.float32)
        if self._camera_names:
            observation["pixels"] = self._pictures(self._sim.data, _IN_MODEL)
        return observation


class _NoRenderer:
    """Stand-in while gym_hil builds a scene: it would open a renderer even where nobody looks."""

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def render(self) -> None: ...


def _simulation(name: str, config: HilSimEnv) -> Any:
    """gym_hil's environment. Raises ConfigError where it is not installed."""
    with needed("The environment 'hil_sim' needs gym_hil", "hil"):
        mujoco = load_mujoco()
        from gym_hil import envs
    chosen = {"random_block_position": config.random_position} if config.task == "pick_cube" else {}
    renderer, mujoco.Renderer = mujoco.Renderer, _NoRenderer
    try:
        return getattr(envs, name)(**chosen)
    finally:
        mujoco.Renderer = renderer
