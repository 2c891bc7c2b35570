"""Pre- and post-processing of `--policy.type=cqn_as`, under the name by which LeRobot looks for it."""

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline

from .configuration_cqn_as import CQNASConfig
from .processors import Stats, make_processors

__all__ = ["make_cqn_as_pre_post_processors"]


def make_cqn_as_pre_post_processors(
    config: CQNASConfig, dataset_stats: Stats | None = None, dataset_meta: Any | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """See `processors.make_processors`."""
    return make_processors(config, dataset_stats, dataset_meta)
