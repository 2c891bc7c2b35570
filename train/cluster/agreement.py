"""What learner and collectors must have in common, checked before anything moves."""

from collections.abc import Mapping

from lerobot_cqn.errors import ConfigError

from .collector import Description, Fit, versions

__all__ = ["check_fit", "check_versions"]

LIMIT_SHARE = 0.02  # of a joint's range that the bounds of two arms may differ by
SPAN_SHARE = 0.05  # that the spans of two calibrations may


def check_versions(found: Description) -> None:
    """Both ends must be of one version. Raises ConfigError by name."""
    for name, own in versions().items():
        if found.versions.get(name) != own:
            raise ConfigError(
                f"{found.host} has {name} {found.versions.get(name)}, the learner {own}: install the same on both."
            )


def check_fit(found: Fit, others: Mapping[int, Fit]) -> None:
    """Arms must mean the same by the same numbers, and have the same limits. Raises ConfigError by name.

    others: of the collectors that are ready, by their number; the first one is compared with.
    """
    if not others:
        return
    number = min(others)
    first = others[number]
    for what, theirs, own in (("control steps a second", first.fps, found.fps),
                              ("steps an episode", first.max_steps, found.max_steps),
                              ("joints", ", ".join(first.limits), ", ".join(found.limits))):  # fmt: skip
        if theirs != own:
            raise ConfigError(f"{what}: {own}, and {theirs} of collector {number}: they must be the same.")
    for joint, span in found.spans.items():
        theirs = first.spans.get(joint, span)
        if abs(span - theirs) > SPAN_SHARE * span:
            raise ConfigError(
                f"its '{joint}' was calibrated over {span} steps of the encoder, that of collector {number} over "
                f"{theirs}: the same number would be another angle; calibrate both over their whole range."
            )
    for joint, (low, high, _) in found.limits.items():
        least, most, _ = first.limits[joint]
        if max(abs(low - least), abs(high - most)) > LIMIT_SHARE * (most - least):
            raise ConfigError(
                f"its '{joint}' may go from {low:.4g} to {high:.4g}, that of collector {number} from {least:.4g} to "
                f"{most:.4g}: give both the same --arm.joint_limits."
            )
