"""gym_aloha with sparse reward and small, fast pictures."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .aloha_config import JOINTS, TASKS, AlohaSmallEnv
from .cameras import RENDER_SIZE, make_lean
from .sim_env import MujocoEnv, Observation
from .simulator import load_mujoco, needed

__all__ = ["Aloha"]

_STAGES = 4  # gym_aloha's highest reward
_LIMIT = 3.2  # rad; no joint turns further
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


class Aloha(MujocoEnv):
    """Two ViperX arms over a table, in MuJoCo at 50 Hz; physics, start and stages are gym_aloha's own.

    Action, (14,) float32: for the left and then the right arm six absolute joint angles in rad and the gripper,
    0 (closed) to 1 (open). Values out of -3.2 to 3.2 are clipped.

    Observation:
        agent_pos: (14,) float32, the same numbers measured.
        environment_state: (7,) float32 an object, position in m and quaternion; not with "pixels".
        pixels: one (image_size, image_size, 3) uint8 a camera, a 4:3 view squeezed to a square; not with "state".

    Success is gym_aloha's last stage, the cube off the table in the left gripper or the peg in the socket; it ends the
    episode. Reward "sparse": 1 on success, else 0; "dense": the present stage, 0 to 1 in quarters.
    `info["is_success"]` is always present, after a step `info["stage"]`, 0 to 4, too.

    Attributes:
        task, task_description: name of the task, and the sentence that instructs it.
        state_names, action_names, environment_state_names: of the numbers above.
        action_kind: "command": each action stands for itself, so that leaving steps out changes no other.
    """

    action_kind: ClassVar[str] = "command"

    def __init__(self, **settings: Any) -> None:
        """Build the scene from fields of `AlohaSmallEnv`.

        Raises:
            ConfigError: a setting that `AlohaSmallEnv` refuses, or gym_aloha is missing.
        """
        config = AlohaSmallEnv(**settings)
        self._simulator, self._diverged = _simulator(str(config.task))
        self._native_task, physics = self._simulator._env.task, self._simulator._env.physics
        # Its own observation draws three cameras at 480x640, whatever was asked for.
        self._native_task.get_observation = self._numbers
        self._data = physics.data.ptr
        make_lean(physics.model.ptr, _picture_size(config.image_size)[1])
        super().__init__(config, physics.model.ptr)
        self._dense = config.reward == "dense"
        self._last: Observation = {}
        self.task_description, objects = TASKS[self.task]
        self.state_names = list(JOINTS)
        self.action_names = list(JOINTS)
        self.environment_state_names = [f"{name}.{part}" for name in objects for part in _POSE]
        self.action_space = gym.spaces.Box(-_LIMIT, _LIMIT, (len(JOINTS),), np.float32)

    def _begin(self, seed: int | None) -> Observation:
        """Lay the scene out as gym_aloha does for the seed, which is drawn where none is given."""
        chosen = int(self.np_random.integers(2**31)) if seed is None else seed
        observation, _ = self._simulator.reset(seed=chosen)
        self._last = self._observe(observation)
        return self._last

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 0.02 s. A simulation that diverges ends the episode as a failure.

        Raises:
            DataError: the action is not fourteen finite numbers.
        """
        checked = self._checked(action)
        try:
            observation, stage, _, _, _ = self._simulator.step(checked)
        except self._diverged:
            return self._last, 0.0, True, False, {"is_success": False, "stage": 0}
        success = bool(stage == _STAGES)
        reward = stage / _STAGES if self._dense else float(success)
        self._last = self._observe(observation)
        return self._last, float(reward), success, False, {"is_success": success, "stage": int(stage)}

    def render(self) -> NDArray[np.uint8]:
        """The table from above, (360, 480, 3) uint8 RGB."""
        return self._cameras.picture(self._data, "top", *RENDER_SIZE)

    def _numbers(self, physics: Any) -> dict[str, Any]:
        """Numbers that gym_aloha reads from its task after a step, without its pictures."""
        return {
            "qpos": self._native_task.get_qpos(physics),
            "env_state": self._native_task.get_env_state(physics),
            "images": {"top": np.zeros(0)},
        }

    def _observe(self, native: dict[str, Any]) -> Observation:
        observation: Observation = {"agent_pos": np.asarray(native["agent_pos"], np.float32)}
        if self._with_state:
            poses = self._native_task.get_env_state(self._simulator._env.physics)
            observation["environment_state"] = np.asarray(poses, np.float32)
        if self._camera_names:
            observation["pixels"] = {name: self._picture(name) for name in self._camera_names}
        return observation

    def _picture(self, camera: str) -> NDArray[np.uint8]:
        """Picture that `cqn-data resize` makes of the public datasets' 480x640: the same view, squeezed."""
        size = self._image_size
        wide = self._cameras.picture(self._data, camera, *_picture_size(size))
        return np.asarray(Image.fromarray(wide).resize((size, size), Image.Resampling.BOX))


def _picture_size(image_size: int) -> tuple[int, int]:
    """Height and width of the 4:3 picture that is drawn: twice as fine, since smoothing by hand costs least."""
    return 2 * image_size, 8 * image_size // 3


def _simulator(task: str) -> tuple[Any, type[Exception]]:
    """gym_aloha's environment of a task, and what it raises when the simulation diverges."""
    with needed("The environment 'aloha_small' needs gym_aloha", "aloha"):
        load_mujoco()
        from dm_control.rl.control import PhysicsError
        from gym_aloha.env import AlohaEnv
    return AlohaEnv(task=task, obs_type="pixels_agent_pos"), PhysicsError
