"""Datasets by their name on the Hub, downloaded as LeRobot does it: into its own cache, by its rules of revisions."""

from pathlib import Path

from lerobot_cqn.errors import DataError
from lerobot_cqn.hub_retry import said

from ..terminal.console import note

__all__ = ["fetched"]


def fetched(repo_id: str, revision: str | None) -> Path:
    """Folder of a dataset in LeRobot's cache, after whatever of it was missing has been downloaded.

    Args:
        repo_id: ``user/name`` on the Hub.
        revision: branch, tag or commit; by default the newest version of the format that this LeRobot reads.

    Raises:
        DataError: offline, not reached, not there, or of another format.
    """
    from huggingface_hub import constants, snapshot_download
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.utils.constants import HF_LEROBOT_HUB_CACHE

    if constants.is_offline_mode():
        raise DataError(
            f"No LeRobotDataset '{repo_id}' on this machine, and HF_HUB_OFFLINE forbids to download it: set --root to"
            " its folder, or unset HF_HUB_OFFLINE."
        )
    try:
        meta = LeRobotDatasetMetadata(repo_id, revision=revision)
        note(f"Downloading {repo_id}, {meta.revision}: {meta.total_episodes} episodes; what is here already is kept.")
        kept = {"repo_type": "dataset", "revision": meta.revision, "cache_dir": HF_LEROBOT_HUB_CACHE}
        return Path(snapshot_download(repo_id, **kept))
    except Exception as error:  # LeRobot, the Hub's client and its transport raise kinds of their own
        raise DataError(
            f"No LeRobotDataset '{repo_id}' on this machine, and the Hub does not give it"
            f"{f' at revision {revision}' if revision else ''}: {said(error)}. Set --root to its folder, or check name"
            " and network."
        ) from error
