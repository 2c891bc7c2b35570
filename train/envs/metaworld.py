"""Meta-World's tasks with a sparse reward, a full state and fast pictures."""

import warnings
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from .cameras import RENDER_SIZE, make_lean
from .metaworld_config import SIMULATOR_HZ, TASKS, MetaworldSparseEnv, state_size
from .scripted_pauses import Pauses
from .sim_env import MujocoEnv, Observation
from .simulator import load_mujoco, needed

__all__ = ["MetaworldSparse", "ScriptedTeleoperator"]

NAMES = ("hand_x", "hand_y", "hand_z", "gripper")
_HAND = 4  # leading numbers of Meta-World's own observation: hand and gripper
_FRAME = 18  # numbers of one of its two frames; behind the hand two poses, padded with zeros
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_UPSIDE_DOWN = ("corner", "corner2", "corner3")
_USUAL_GAIN = 25.0  # of the experts, per m: what they multiply the way that is left with
_METRES = 0.01  # displacement in a simulator step by an action of 1
_CORNER2 = (0.75, 0.075, 0.7)  # m; nearer to the table than Meta-World's own


class MetaworldSparse(MujocoEnv):
    """One of Meta-World's tasks.

    Action, (4,) float32 in [-1, 1]: the hand's displacement along x, y, z, 1 for a centimetre in each simulator step,
    of which there are 80 / fps in a control step, and the gripper's effort, -1 (open) to 1 (close). Values out of
    range are clipped.

    Observation:
        agent_pos: (4,) float32, the hand's x, y, z in m and the gripper, 0 (closed) to 1 (open).
        environment_state: (10,) float32, with two objects (17,): each object's position in m and quaternion, then the
            goal's position in m, which Meta-World hides by default; not with "pixels". Dimensions that a task never
            changes are in it all the same. Velocities are not; stack observations where they matter.
        pixels: one (image_size, image_size, 3) uint8 a camera; not with "state".

    Reward 1 at the first success, which ends the episode; else 0. `info["is_success"]` is always present.

    Attributes:
        task, task_description: Meta-World's name of the task, and the sentence that instructs it.
        state_names, action_names: of `agent_pos` and the action.
        environment_state_names: of objects and goal.
        simulator: Meta-World's environment (`SawyerXYZEnv`).
        raw_observation: (39,) Meta-World's own observation: present and former frame of 18 numbers, and the goal.
        repeat: simulator steps for which an action is held.
        action_kind: "command": each action stands for itself, so that leaving steps out changes no other.
    """

    action_kind: ClassVar[str] = "command"

    def __init__(self, **settings: Any) -> None:
        """Build the scene from fields of `MetaworldSparseEnv`.

        Raises:
            ConfigError: a setting that `MetaworldSparseEnv` refuses, or metaworld is missing.
        """
        config = MetaworldSparseEnv(**settings)
        self._mujoco, make, self._expert = _load(str(config.task))
        self.simulator = make()
        self.simulator.seeded_rand_vec = True
        self.simulator._set_task_called = True
        # Longer episodes are the time limit's affair; Meta-World would raise.
        self.simulator.max_path_length = 10**9
        make_lean(self.simulator.model, config.image_size)
        _place_cameras(self.simulator.model)
        super().__init__(config, self.simulator.model)
        self.repeat = SIMULATOR_HZ // config.fps
        self.raw_observation: NDArray[np.float64] = np.zeros(2 * _FRAME + 3)
        self.task_description = TASKS[self.task.removesuffix("-v3")]
        self.state_names = list(NAMES)
        self.action_names = list(NAMES)
        self._poses = state_size(self.task) - 3
        objects = [f"object{i or ''}_{axis}" for i in range(self._poses // 7) for axis in _POSE]
        self.environment_state_names = [*objects, "goal_x", "goal_y", "goal_z"]
        self.action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def _begin(self, seed: int | None) -> Observation:
        """Lay the scene out; an episode follows from its seed alone."""
        simulator = self.simulator
        if seed is not None:
            simulator.seed(seed)
        # Meta-World's reset lays the scene out twice and measures the goal in between: places drawn anew for the
        # second time would not fit that goal. So they are drawn first and then kept.
        self._mujoco.mj_resetData(simulator.model, simulator.data)
        simulator._freeze_rand_vec = False
        simulator.reset_model()
        simulator._freeze_rand_vec = True
        simulator.reset()
        # It moves objects last and looks at them without this.
        self._mujoco.mj_forward(simulator.model, simulator.data)
        frame = simulator._get_curr_obs_combined_no_goal()
        self.raw_observation = np.concatenate([frame, frame, simulator._get_pos_goal()])
        return self._observe()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 1 / fps seconds, or until success.

        Raises:
            DataError: the action is not four finite numbers.
        """
        checked = self._checked(action)
        success = False
        for _ in range(self.repeat):
            raw, _, _, _, info = self.simulator.step(checked)
            success = bool(info["success"])
            if success:
                break
        self.raw_observation = np.concatenate([raw[: 2 * _FRAME], self.simulator._get_pos_goal()])
        return self._observe(), float(success), success, False, {"is_success": success}

    def render(self) -> NDArray[np.uint8]:
        """The table from the corner, (360, 480, 3) uint8 RGB."""
        return self._cameras.picture(self.simulator.data, "corner2", *RENDER_SIZE)

    def scripted_teleoperator(self, pause_share: float = 0.0, seed: int = 0) -> "ScriptedTeleoperator":
        """Meta-World's own expert for the task; see `ScriptedTeleoperator`."""
        return ScriptedTeleoperator(self, pause_share=pause_share, seed=seed)

    def make_expert(self) -> Any:
        """A new scripted policy of Meta-World's for the task, from raw observation to action."""
        return self._expert()

    def _observe(self) -> Observation:
        raw = self.raw_observation.astype(np.float32)
        observation: Observation = {"agent_pos": raw[:_HAND]}
        if self._with_state:
            objects = raw[_HAND : _HAND + self._poses]
            observation["environment_state"] = np.concatenate([objects, raw[-3:]])
        if self._camera_names:
            observation["pixels"] = self._pictures(self.simulator.data)
        return observation


class ScriptedTeleoperator:
    """Meta-World's scripted expert at the control rate, with the pauses of a person.

    While moving, the action depends on the present state alone. The expert was made for 80 Hz: displacements that end
    before the goal are shortened, so that holding them longer does not overshoot. While pausing it is a zero
    displacement with the gripper as it was; each step begins a pause with the same probability.

    Attributes:
        pausing: whether the last `act` was a pause.
    """

    pausing: bool

    def __init__(self, env: MetaworldSparse, pause_share: float = 0.0, seed: int = 0) -> None:
        """Steer `env` (unwrapped).

        Args:
            env: the environment, which the caller steps.
            pause_share: expected share of still steps, [0, 0.9].
            seed: of the pauses, until `reset` gives another.

        Raises:
            ConfigError: a share out of range.
        """
        self._env = env
        self._damping = _damping(env.repeat)
        self._pauses = Pauses(pause_share)
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Begin an episode; call it after the environment's reset. The same seed gives the same pauses."""
        self._pauses.reset(np.random.default_rng(seed))
        self._expert = self._env.make_expert()
        self._gripper = -1.0
        self.pausing = False

    def act(self) -> NDArray[np.float32]:
        """Action for the present state, (4,) float32 in [-1, 1]."""
        self.pausing = self._pauses.next()
        if self.pausing:
            return np.array([0.0, 0.0, 0.0, self._gripper], np.float32)
        with warnings.catch_warnings():
            # It warns whenever a displacement is clipped, which is how it moves fast.
            warnings.simplefilter("ignore")
            wanted = np.array(self._expert.get_action(self._env.raw_observation), np.float64)
        wanted[:3] *= self._damping
        action: NDArray[np.float32] = np.clip(wanted, -1.0, 1.0).astype(np.float32)
        self._gripper = float(action[3])
        return action


def _damping(repeat: int) -> float:
    """Share of the expert's displacement that, held for `repeat` simulator steps, ends where asking each time would."""
    share = _USUAL_GAIN * _METRES
    return float((1.0 - (1.0 - share) ** repeat) / (share * repeat))


def _place_cameras(model: Any) -> None:
    """Turn the cameras that stand on their heads, and bring one nearer."""
    for name in _UPSIDE_DOWN:
        w, x, y, z = model.camera(name).quat
        # Half a turn about the viewing axis.
        model.camera(name).quat = (-z, y, -x, w)
    model.camera("corner2").pos = _CORNER2


def _load(task: str) -> tuple[Any, Any, Any]:
    """The mujoco module, and Meta-World's environment and expert classes for a task."""
    with needed("Meta-World's tasks need metaworld", "metaworld"):
        mujoco = load_mujoco()
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS
        from metaworld.policies import ENV_POLICY_MAP
    return mujoco, ALL_V3_ENVIRONMENTS[task], ENV_POLICY_MAP[task]
