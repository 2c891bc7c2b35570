"""gym_hil's simulated Franka arm, seeded and without its expensive renderer."""

import contextlib
from collections.abc import Iterator
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError

from .cameras import Cameras
from .common import RENDER_SIZE, checked_action, dict_space, make_lean
from .hil_config import CAMERAS, FPS, STATE_NAMES, STEP, TASKS, check_settings
from .hil_expert import HilTeleoperator
from .simulator import load_mujoco

__all__ = ["HilSim", "preserved_numpy_random"]

_IN_MODEL = {"front": "front", "wrist": "handcam_rgb"}
_CLOSED = 255.0  # gym_hil's gripper command

Observation = dict[str, Any]


class HilSim(gym.Env[Observation, NDArray[np.float32]]):
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
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": FPS}

    def __init__(
        self,
        task: str = "pick_cube",
        obs_type: str = "state",
        cameras: list[str] | tuple[str, ...] = CAMERAS,
        image_size: int = 84,
        random_position: bool = True,
        render_mode: str | None = "rgb_array",
    ) -> None:
        """Build the scene; no graphics context is opened before the first picture.

        Raises:
            ConfigError: an unknown task, obs_type or camera; a size out of range; gym_hil is missing.
        """
        check_settings(task, obs_type, cameras, image_size)
        self._objects = TASKS[task].objects
        self._sim = _simulation(task, random_position)
        make_lean(self._sim.model, image_size)
        self._cameras = Cameras(self._sim.model)
        self._camera_names = tuple(cameras) if obs_type != "state" else ()
        self._with_state = obs_type != "pixels"
        self._image_size = image_size
        self.fps = FPS
        self.render_mode = render_mode
        self.task = task
        self.task_description = TASKS[task].description
        self.state_names = list(STATE_NAMES)
        self.action_names = ["delta_x", "delta_y", "delta_z", "gripper"]
        self.environment_state_names = [f"{name}.{axis}" for name in self._objects for axis in "xyz"]
        lowest = np.array([-1.0, -1.0, -1.0, 0.0], np.float32)
        self.action_space = gym.spaces.Box(lowest, np.ones(4, np.float32), dtype=np.float32)
        states = len(self.environment_state_names) if self._with_state else 0
        self.observation_space = dict_space(len(STATE_NAMES), states, self._camera_names, image_size)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the same `seed` gives the same episode, without one the random stream goes on.

        `options` is accepted for callers that pass marks of their own; none changes anything.
        """
        super().reset(seed=seed)
        # gym_hil ignores a seed and draws from numpy's global state.
        with preserved_numpy_random(int(self.np_random.integers(2**32))):
            self._sim.reset()
        return self._observe(), {"is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 0.1 s.

        Raises:
            DataError: the action is not four finite numbers.
        """
        checked = checked_action(action, self.action_space, self.action_names)
        # gym_hil's own action is a change of the gripper's closure.
        native = np.concatenate([checked[:3] * STEP, np.zeros(3), [checked[3] - self.closure]])
        _, reward, terminated, _, _ = self._sim.step(native)
        success = bool(reward == 1.0)
        return self._observe(), float(success), bool(terminated), False, {"is_success": success}

    def render(self) -> NDArray[np.uint8]:
        """The front camera, (360, 480, 3) uint8 RGB."""
        return self._cameras.picture(self._sim.data, "front", *RENDER_SIZE)

    def close(self) -> None:
        """Release graphics contexts; calling it twice is harmless."""
        self._cameras.close()

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

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the movable objects."""
        return self._objects

    def place(self, name: str) -> NDArray[np.float64]:
        """Position of an object or field, (3,) m."""
        position: NDArray[np.float64] = self._sim.data.sensor(f"{name}_pos").data.copy()
        return position

    # -- inside -----------------------------------------------------------------------------------------------

    def _observe(self) -> Observation:
        observation: Observation = {"agent_pos": self._sim.get_robot_state().astype(np.float32)}
        if self._with_state:
            places = np.concatenate([self.place(name) for name in self._objects])
            observation["environment_state"] = places.astype(np.float32)
        if self._camera_names:
            size = self._image_size
            observation["pixels"] = {
                name: self._cameras.picture(self._sim.data, _IN_MODEL[name], size, size) for name in self._camera_names
            }
        return observation


@contextlib.contextmanager
def preserved_numpy_random(seed: int) -> Iterator[None]:
    """Seed numpy's global random state inside, and put the caller's back afterwards."""
    before = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(before)


class _NoRenderer:
    """Stands in while gym_hil builds a scene: it would open a renderer even where nobody looks."""

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def render(self) -> None: ...


def _simulation(task: str, random_position: bool) -> Any:
    try:
        mujoco = load_mujoco()
        from gym_hil import envs
    except (ImportError, ConfigError) as error:
        raise ConfigError(
            "The environment 'hil_sim' needs gym_hil, which is not installed: "
            "run `pip install 'lerobot_policy_cqn[hil]'`."
        ) from error
    chosen = {"random_block_position": random_position} if task == "pick_cube" else {}
    renderer, mujoco.Renderer = mujoco.Renderer, _NoRenderer
    try:
        return getattr(envs, TASKS[task].simulation)(**chosen)
    finally:
        mujoco.Renderer = renderer
