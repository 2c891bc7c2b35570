"""A run from beginning to end: built, trained, saved where it is stopped, reported, pushed."""

import contextlib
from collections.abc import Callable

from .build import MakeWorld, build
from .config import ValidRun
from .interfaces import Interrupted, Monitor
from .run.judgement import practice, read_tables
from .run.report import write_report

__all__ = ["execute"]


def execute(
    valid: ValidRun, monitor: Monitor, should_stop: Callable[[], bool], make_world: MakeWorld | None = None
) -> int:
    """Build and train; 0 when complete, 130 when stopped on request with a checkpoint saved.

    make_world: as in `build`. Raises CQNError, OSError.
    """
    with contextlib.ExitStack() as stack:
        trainer = build(valid, monitor, should_stop, stack, make_world=make_world)
        again = f"Continue with: cqn-train --resume=true --output_dir={valid.output_dir}"
        try:
            trainer.run()
        except Interrupted:
            trainer.save()
            monitor.message(f"Stopped. {again}")
            return 130
        except OSError:  # of the machine (no descriptors left, a device gone): what was learned is sound
            if (
                trainer.counters.updates or trainer.counters.episodes
            ):  # else nothing is learned, and the same command begins again
                with contextlib.suppress(OSError):
                    trainer.save()
                    monitor.message(f"Saved. {again}")
            raise
        monitor.message(f"Policy: {valid.output_dir}/checkpoints/last/pretrained_model")
        if report := write_report(valid.output_dir):
            monitor.message(f"{practice(read_tables(valid.output_dir))}\nReport: {report}")
    policy = valid.policy
    if policy.push_to_hub:
        from .push.config import PushConfig
        from .push.send import push

        push(
            PushConfig(
                run=str(valid.output_dir), repo_id=str(policy.repo_id), private=bool(policy.private),
                license=policy.license, tags=list(policy.tags or ()),
            )
        )  # fmt: skip
    return 0
