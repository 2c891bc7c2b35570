"""RLPolicy: the thin surface LeRobot's commands talk to, whatever the method."""

import logging
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from huggingface_hub import ModelCard, constants
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from . import processors  # noqa: F401  # registers the steps that checkpoints name
from .base_config import RLConfig
from .correction import base_of
from .errors import ConfigError, DataError
from .hub_retry import HubError, refuse_to_start, retried, said
from .model import Model
from .model_card import ModelFacts, as_readme, commands, data_facts
from .n_step import n_step_return
from .schema import ACTION, BASE_ACTION, NEXT_REWARD, Batch, Observation

__all__ = ["RLPolicy"]

logger = logging.getLogger(__name__)

PUSH_WAITS = (2.0, 8.0)  # seconds before each further try


class RLPolicy(PreTrainedPolicy):
    """A model with the history of its observations, and LeRobot's batches turned into n-step transitions.

    A subclass names its configuration and model. dataset_meta (from lerobot-train) tells where episodes end, which the
    batches do not say.
    Raises ConfigError when features do not fit.
    """

    config_class = RLConfig  # LeRobot asks every class for these two; subclasses have their own
    name = "rl"
    model_class: ClassVar[Callable[..., Model]]
    config: RLConfig
    model: Model
    episode_start: Tensor
    episode_end: Tensor

    def __init__(self, config: RLConfig, dataset_stats: Any = None, dataset_meta: Any = None, **_: Any) -> None:
        super().__init__(config)
        if dataset_meta is not None and config.push_to_hub:  # at the end of a training that begins now
            refuse_to_start()
            config.refuse_local_base()
        _leave_out_depth(config, dataset_meta)
        _see_the_base(config)
        config.validate_features()
        shapes = {key: feature.shape for key, feature in sorted(config.image_features.items())}
        self.view_keys = tuple(shapes)
        self.low_dim_keys = tuple(config.low_dim_features)
        low_dim_size = sum(feature.shape[0] for feature in config.low_dim_features.values())
        assert config.action_feature is not None  # noqa: S101  # validate_features has checked it
        self.action_dims = config.action_feature.shape[0]
        views = {key: (shape[0], shape[1], shape[2]) for key, shape in shapes.items()}
        self.model = type(self).model_class(views, low_dim_size, self.action_dims, config.settings)
        self._queue: deque[dict[str, Tensor]] = deque(maxlen=config.settings.frame_stack)
        self._remember_episodes(dataset_meta)

    def _remember_episodes(self, meta: Any) -> None:
        """Keep the first and one-past-last global index of each episode; not part of the checkpoint."""
        self.has_reward = meta is not None and NEXT_REWARD in meta.features
        rows = ([], []) if meta is None else (meta.episodes["dataset_from_index"], meta.episodes["dataset_to_index"])
        for name, row in zip(("episode_start", "episode_end"), rows, strict=True):
            self.register_buffer(name, torch.as_tensor(list(row), dtype=torch.int64), persistent=False)
        if meta is not None and not self.has_reward and self.config.settings.rl_loss_scale > 0:
            logger.warning(
                "The dataset has no '%s' column: the last step of each episode counts as the success (reward 1). "
                "Drop failed episodes first, or label them.",
                NEXT_REWARD,
            )

    # -- acting ----------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget the frame history; call at the start of each episode."""
        self._queue.clear()
        self.forget_plan()

    def forget_newest(self) -> None:
        """Forget the last frame that was observed; another one takes its place."""
        self._queue.pop()
        self.forget_plan()

    def forget_plan(self) -> None:
        """Forget what was planned ahead for a course that the episode did not take: the base's, where there is one."""
        if self.config.base_path is not None:
            base_of(self.config.base_path, self.config.base_revision).forget()

    def observe(self, batch: dict[str, Tensor]) -> Observation:
        """Push one frame [B, ...] per feature and return the stacked history; the first frame is repeated.

        Raises DataError when a feature the policy was trained on is missing or has another shape.
        """
        frame = {}
        for key in (*self.view_keys, *self.low_dim_keys):
            if key not in batch:
                raise DataError(
                    f"The observation lacks '{key}': expected {[*self.view_keys, *self.low_dim_keys]}, found "
                    f"{sorted(k for k in batch if k.startswith('observation.'))}."
                )
            expected = (self.config.input_features or {})[key].shape
            if tuple(batch[key].shape[1:]) != tuple(expected):
                raise DataError(f"'{key}' has shape {tuple(batch[key].shape[1:])}, expected {tuple(expected)}.")
            frame[key] = batch[key]
        if not self._queue:
            self._queue.extend([frame] * (self.config.settings.frame_stack - 1))
        self._queue.append(frame)
        return self.stack({key: torch.stack([past[key] for past in self._queue], dim=1) for key in frame})

    def stack(self, frames: dict[str, Tensor]) -> Observation:
        """Frames [B, S, ...] of each feature -> Observation (frames on the channels, low-dim concatenated)."""
        views = tuple(frames[key].flatten(1, 2) for key in self.view_keys)
        if not self.low_dim_keys:
            return Observation(views)
        low_dim = torch.cat([frames[key] for key in self.low_dim_keys], dim=-1)  # [B, S, P]
        return Observation(views, low_dim.flatten(1))

    @torch.no_grad()
    def act(self, batch: dict[str, Tensor], *, explore: bool = False) -> tuple[Tensor, Tensor]:
        """Action [B, D] in [-1, 1], with the method's exploration where it is asked for, and its Q [B]."""
        return self.model.act(self.observe(batch), explore)

    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Deterministic action [B, D] in [-1, 1]."""
        return self.act(batch)[0]

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """A chunk of one action, [B, 1, D]."""
        return self.select_action(batch, **kwargs)[:, None]

    # -- offline training by lerobot-train ---------------------------------------------------------------------

    def get_optim_params(self) -> Any:
        """Everything but the target networks, which follow by averaging."""
        return [p for p in self.parameters() if p.requires_grad]

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Loss of Algorithm 2 on a batch of LeRobot's data loader; every sample counts as a demonstration."""
        data = self.to_batch(batch)
        if self.training:
            data = self.model.augment_batch(data)
        loss, stats = self.model.loss(data)
        return loss, {name: value.item() for name, value in stats.items() if name != "loss"}

    def update(self) -> None:
        """Polyak step; LeRobot calls it after each optimiser step."""
        self.model.update_target()

    def to_batch(self, batch: dict[str, Tensor]) -> Batch:
        """n-step transitions from LeRobot's batch.

        Past the end of an episode the loader repeats the last frame and its reward: rewards are masked, and
        the repeated last observation stands in for the final one, which datasets do not store.
        """
        s = self.config.settings
        deltas = self.config.observation_delta_indices
        now = [deltas.index(index) for index in range(1 - s.frame_stack, 1)]
        frames = {key: self._with_time(batch, key) for key in (*self.view_keys, *self.low_dim_keys)}
        observation = self.stack({key: value[:, now] for key, value in frames.items()})
        action, real = self.actions_of(batch)
        demo = torch.ones_like(action[:, :1])
        if s.rl_loss_scale == 0:  # imitation only: rewards and next observations are not read
            return Batch(
                observation=observation,
                action=action,
                reward=demo * 0,
                discount=demo * 0,
                next_observation=observation,
                demo=demo,
                real=real,
            )
        reward, discount, window = self._n_step(batch, action)
        # The stack that ends where the window does. An offset that was not loaded lies at the episode's end, where
        # the last one, repeated, is the same frame.
        loaded = [deltas.index(i) if i in deltas else -1 for i in range(1 - s.frame_stack, s.n_step + 1)]
        row = torch.arange(len(action), device=action.device)[:, None]
        later = torch.tensor(loaded, device=action.device)[window + torch.arange(s.frame_stack, device=action.device)]
        next_observation = self.stack({key: value[row, later] for key, value in frames.items()})
        return Batch(
            observation=observation,
            action=action,
            reward=reward,
            discount=discount,
            next_observation=next_observation,
            demo=demo,
            real=real,
        )

    def actions_of(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor | None]:
        """What was done in LeRobot's batch, [B, D], and which of its numbers count (`Batch.real`)."""
        return batch[ACTION].reshape(len(batch[ACTION]), -1, self.action_dims)[:, 0], None

    def _n_step(self, batch: dict[str, Tensor], like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Discounted reward sum, bootstrap discount and length of the window in steps, all [B, 1]."""
        if not len(self.episode_end):
            raise ConfigError(
                "The policy was made without a dataset and cannot tell where episodes end: make it with "
                "`make_policy(cfg, ds_meta=...)`, or set `--policy.rl_loss_scale=0`."
            )
        s = self.config.settings
        end = self.episode_end.to(like.device)[batch["episode_index"].flatten().long()]
        remaining = (end - batch["index"].flatten().long())[:, None]  # steps to the end of the episode, >= 1
        if self.has_reward:
            rewards = batch[NEXT_REWARD].view(-1, s.n_step).to(like)
        else:
            rewards = (torch.arange(s.n_step, device=like.device) == remaining - 1).to(like)
        at_last = (remaining - 1).clamp(max=s.n_step - 1)
        # A success is a real termination; an episode that ended without one only ran out of time.
        terminal = (remaining <= s.n_step) & (rewards.gather(1, at_last) > 0)
        window = remaining.clamp(max=s.n_step)
        return *n_step_return(rewards, window, terminal, s.discount), window

    def _with_time(self, batch: dict[str, Tensor], key: str) -> Tensor:
        if key not in batch:
            raise DataError(
                f"The batch lacks '{key}': found {sorted(k for k in batch if k.startswith('observation.'))}."
            )
        # With a single offset the loader drops the time axis of videos and vectors; of a vector of one number, its own.
        return batch[key].reshape(len(batch[key]), -1, *(self.config.input_features or {})[key].shape)

    # -- the Hub -----------------------------------------------------------------------------------------------

    def generate_model_card(
        self, dataset_repo_id: str, model_type: str, license: str | None, tags: list[str] | None, cfg: Any = None,
        dataset_meta: Any = None,
    ) -> ModelCard:  # fmt: skip
        """The card that `lerobot-train` pushes; `model_type` is the configuration's own."""
        env, repo_id = getattr(cfg, "env", None), self.config.repo_id or f"user/{model_type}"
        local = getattr(getattr(cfg, "dataset", None), "root", None) is not None
        data = data_facts(dataset_meta, dataset_repo_id, public=not local) if dataset_meta is not None else None
        rows, where = {"Trained with": "lerobot-train, offline"}, ["--dataset.root=..."] if local else []
        if cfg is not None:
            rows |= {"Updates": str(cfg.steps), "Batch size": str(cfg.batch_size), "Seed": str(cfg.seed)}
        tasks = list(dataset_meta.tasks.index) if dataset_meta is not None else []
        facts = ModelFacts(
            repo_id, self.config, str(tasks[0]) if tasks else dataset_repo_id, rows,
            commands(repo_id, env=env, dataset=dataset_repo_id, more=where), license, tags or (), data,
        )  # fmt: skip
        return ModelCard(as_readme(facts, constants.ENDPOINT))

    def push_model_to_hub(self, cfg: Any, *args: Any, **kwargs: Any) -> None:
        """Push as LeRobot does, again where that may help.

        Raises HubError, which names the command that pushes later: the run is on disk.
        """

        def explained(error: BaseException) -> HubError:
            return HubError(
                f"{self.config.repo_id} could not be pushed ({said(error)}). The run is safe in {cfg.output_dir}; push "
                f"it when that is mended: cqn-push --run={cfg.output_dir} --repo_id={self.config.repo_id}"
            )

        push = super().push_model_to_hub
        retried(lambda: push(cfg, *args, **kwargs), PUSH_WAITS, explained, logger.warning)


def _see_the_base(config: RLConfig) -> None:
    """Let a policy that corrects another one see what that one would do."""
    if config.base_path is not None and config.action_feature is not None:
        seen = PolicyFeature(FeatureType.STATE, tuple(config.action_feature.shape))
        config.input_features = {**(config.input_features or {}), BASE_ACTION: seen}


def _leave_out_depth(config: RLConfig, meta: Any) -> None:
    """Take the depth cameras of the dataset `meta` out of what a policy sees: distances are not scaled like colours."""
    seen = [key for key in getattr(meta, "depth_keys", ()) if key in (config.input_features or {})]
    if seen:
        config.input_features = {k: f for k, f in (config.input_features or {}).items() if k not in seen}
        logger.warning("Depth is not looked at: %s is left out; the policy sees the other cameras.", ", ".join(seen))
