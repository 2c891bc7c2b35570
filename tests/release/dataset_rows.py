"""Datasets and machines with LeRobot's commands, the way they are tried (rows.py)."""

from .rows import Judge, Row, Try, ends_well, holds, says, writes


def _edit(operation: str, options: str, judge: Judge, target: str, note: str = "") -> Row:
    new = f"--new_repo_id=local/{target} --new_root={target}"
    line = f"$EDIT {new} --operation.type={operation} {options}".strip()
    return Row("lerobot-edit-dataset", (Try(line, judge),), {"": note} if note else {}, target=target)


DATASETS = (
    _edit(
        "delete_episodes",
        "--operation.episode_indices=[0]",
        holds("deleted", 1),
        "deleted",
        "`cqn-data drop` keeps history and bounds.",
    ),
    Row(
        "lerobot-edit-dataset",
        (
            Try(
                '$EDIT --new_root=split --operation.type=split \'--operation.splits={"a": [0], "b": [1]}\'',
                holds("split/a", 1),
            ),
        ),
        target="split/a",
    ),
    Row(
        "lerobot-edit-dataset",
        (
            Try(
                "lerobot-edit-dataset --new_repo_id=local/merged --new_root=merged "
                "--operation.type=merge \"--operation.repo_ids=['local/clean', 'local/clean']\" "
                "\"--operation.roots=['clean', 'clean']\"",
                holds("merged", 4),
            ),
        ),
        target="merged",
    ),
    _edit(
        "remove_feature",
        "\"--operation.feature_names=['next.success']\"",
        holds("removed", 2, "next.success", there=False),
        "removed",
        "",
    ),
    _edit("recompute_stats", "", writes("stats/meta/stats.json"), "stats"),
    Row(
        "lerobot-edit-dataset",
        (
            Try(
                "lerobot-edit-dataset --repo_id=local/copy --root=copy --operation.type=modify_tasks "
                "'--operation.new_task=Press it.'",
                holds("copy", 2),
            ),
        ),
        {"": "Changes the dataset in place."},
        target="copy",
    ),
    Row(
        "lerobot-edit-dataset",
        (
            Try(
                "lerobot-edit-dataset --repo_id=local/seen --root=pictures "
                "--new_repo_id=local/again --new_root=again --operation.type=reencode_videos",
                holds("again", 1),
            ),
        ),
    ),
    Row(
        "lerobot-edit-dataset",
        (
            Try(
                "lerobot-edit-dataset --repo_id=local/images --root=images --new_repo_id=local/films "
                "--new_root=films --operation.type=convert_image_to_video",
                holds("films", 2),
            ),
        ),
        {
            "array.float32": "LeRobot cannot convert datasets with a column of two dimensions, here `keypoint` of a "
            "Zarr store; others were not tried."
        },
        "`cqn-data convert --video=true` (the default) writes films at once.",
    ),
    Row(
        "lerobot-edit-dataset",
        (Try("$EDIT --operation.type=info", says("FPS")),),
        {"": "`cqn-data inspect` says more."},
    ),
    Row(
        "lerobot-dataset-viz",
        (
            Try(
                "lerobot-dataset-viz --repo-id=local/clean --root=clean --episode-index=0 --save=1 "
                "--output-dir=viewed --num-workers=0",
                writes("viewed/*.rrd"),
            ),
        ),
    ),
    Row(
        "lerobot-imgtransform-viz",
        (
            Try(
                "lerobot-imgtransform-viz --repo_id=local/seen --root=pictures --image_transforms.enable=true",
                writes("outputs/image_transforms/seen/original_frame.png"),
            ),
            Try(
                "lerobot-imgtransform-viz --repo_id=local/pictures --image_transforms.enable=true",
                writes("outputs/image_transforms/pictures/original_frame.png"),
                label="a dataset in LeRobot's own folder (`HF_LEROBOT_HOME`)",
            ),
        ),
        {"(?s).*": "It does not hand `--root` on."},
    ),
    Row(
        "lerobot-train-tokenizer",
        (
            Try(
                "lerobot-train-tokenizer --repo_id=local/clean --root=clean --encoded_dims=0:7 "
                "--action_horizon=5 --output_dir=tokens",
                writes("tokens/*"),
            ),
        ),
        {
            "": "Makes action tokens for policies of another kind (pi0-FAST); CQN has its own bins. It reads the "
            "dataset, then "
            "needs a file from the Hub, which was out of reach here."
        },
        concerned=False,
    ),
    Row(
        "lerobot-annotate",
        (Try("lerobot-annotate --root=copy", ends_well),),
        {"": "Adds sentences to datasets with a language model that one must bring; CQN reads no language."},
        concerned=False,
    ),
)

MACHINES = (
    Row("lerobot-calibrate", (Try("lerobot-calibrate --robot.type=sim_ur5e --robot.id=sim", ends_well),)),
    Row(
        "lerobot-find-joint-limits",
        (Try("lerobot-find-joint-limits $ARM $LEADER --urdf_path=arm.urdf --teleop_time_s=2", says("FINAL RESULTS")),),
        {"invalid choice": "It knows LeRobot's own arms only: it does not look for plugins."},
        "`cqn-train` takes its limits from the demonstrations, or from `--arm.joint_limits`.",
    ),
    Row(
        "lerobot-setup-motors",
        (Try("lerobot-setup-motors --robot.type=sim_ur5e --robot.id=sim", ends_well),),
        {"does not support motor setup": "The simulated arm is found, and has no motors to number."},
        concerned=False,
    ),
    Row(
        "lerobot-setup-can",
        (Try("lerobot-setup-can", ends_well),),
        {"": "Sets up CAN interfaces of motors."},
        concerned=False,
    ),
    Row("lerobot-find-port", (Try("lerobot-find-port", ends_well),), {"": "Asks to unplug a cable."}, concerned=False),
    Row(
        "lerobot-find-cameras",
        (Try("lerobot-find-cameras", ends_well),),
        {"": "Lists cameras that are plugged in; what it finds goes into `--robot.cameras`."},
        concerned=False,
    ),
    Row(
        "lerobot-info",
        (Try("lerobot-info", says("LeRobot version")),),
        {
            "libtorchcodec": "Without FFmpeg's libraries it fails on torchcodec, with or without this package.",
            "": "Prints versions, for reports of problems.",
        },
        concerned=False,
    ),
)
