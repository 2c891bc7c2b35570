"""``cqn-data resize``: smaller pictures, e.g. 480x640 -> 84x84, cut out first where asked."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError, one_of
from lerobot_cqn.history_text import shown

from ..terminal.console import note, table
from .job import Step, settings_of

if TYPE_CHECKING:
    from ..views.view import DerivedView, View

__all__ = ["Resize"]


@dataclasses.dataclass
class Resize(Step):
    """Settings of ``cqn-data resize``."""

    name = "resize"
    example = """
cqn-data resize --repo_id=local/pick --root=data/pick --new_root=data/pick_84 --size='[84, 84]'
cqn-data resize --repo_id=local/pick --root=data/pick --new_root=data/pick_84 --size='[84, 84]' \\
    --crop='{"top": [0, 80, 480, 480]}'
"""
    notes = """
Crops are [top, left, height, width] in pixels of the present pictures. Shrinking uses the area filter, which does not
alias. A camera may be named in full (observation.images.top) or by its last part (top).
"""

    size: list[int] = dataclasses.field(
        default_factory=lambda: [84, 84], metadata={"help": "Height and width in pixels; 84x84 in the paper."}
    )
    crop: dict[str, list[int]] = dataclasses.field(
        default_factory=dict, metadata={"help": """Part of a camera's picture, e.g. '{"top": [0, 80, 480, 480]}'."""}
    )
    cameras: list[str] = dataclasses.field(
        default_factory=list, metadata={"help": "Only these cameras; by default all."}
    )

    def validate(self) -> None:
        """Check sizes; raises ConfigError naming the option, what was expected and what was found."""
        if len(self.size) != 2 or not all(32 <= n <= 4096 for n in self.size):
            raise ConfigError(f"Expected --size='[HEIGHT, WIDTH]' with 32 to 4096 pixels each, got {self.size}.")
        if any(n % 2 for n in self.size):
            raise ConfigError(f"Expected even numbers in --size, as video codecs do, got {self.size}.")
        for name, box in self.crop.items():
            if len(box) != 4 or min(box[:2]) < 0 or min(box[2:]) < 2:
                raise ConfigError(f"Expected --crop='{{\"{name}\": [top, left, height, width]}}', got {box}.")

    def on(self, view: "View") -> "DerivedView":
        """Check crops against the pictures; raises ConfigError for an unknown camera or a box outside."""
        from ..disk.pictures import picture_size
        from ..views.episode import Camera
        from ..views.resized import Resized

        if not view.cameras:
            raise ConfigError(
                "The dataset has no camera: there is nothing to resize; without cameras use the recipe arm_state."
            )
        crops = {_camera(view, name): tuple(box) for name, box in self.crop.items()}
        chosen = [_camera(view, name) for name in self.cameras] or list(view.cameras)
        shapes, rows = dict(view.cameras), []
        for key in dict.fromkeys([*chosen, *crops]):
            before = view.cameras[key]
            if before != Camera():
                raise ConfigError(f"'{key}' is resized twice in one run; give --crop and --size together.")
            height, width = picture_size(view.features[key])
            box = crops.get(key)
            if box and (box[0] + box[2] > height or box[1] + box[3] > width):
                raise ConfigError(f"The crop {list(box)} of '{key}' lies outside its {height}x{width} picture.")
            size = (self.size[0], self.size[1]) if key in chosen else (box[2], box[3]) if box else None
            shapes[key] = Camera(crop=box, size=size)  # type: ignore[arg-type]  # four numbers, checked above
            part = box[2:] if box else (height, width)
            if size and (size[0] > part[0] or size[1] > part[1]):
                note(f"'{key}' grows from {part[0]}x{part[1]} to {size[0]}x{size[1]}.")
            if size and abs(size[0] * part[1] / (size[1] * part[0]) - 1) > 0.05:
                note(f"'{key}' is squeezed from {part[0]}x{part[1]} to {size[0]}x{size[1]}; --crop keeps proportions.")
            rows.append(
                [key, f"{height}x{width}", str(list(box)) if box else "-", f"{size[0]}x{size[1]}" if size else "-"]
            )
        table(["camera", "before", "crop", "after"], rows)
        after = Resized(view, shapes=shapes)
        after.entry.update(settings=settings_of(self))
        return after

    @staticmethod
    def told(entry: Mapping[str, Any]) -> str:
        """The sentence for the history."""
        (height, width), crop = entry["settings"]["size"], entry["settings"].get("crop")
        if not crop:
            return f"Scaled the pictures to {height}x{width}."
        parts = f"{shown(crop)}: top, left, height, width"
        return f"Cut out parts of the pictures ({parts}), then scaled them to {height}x{width}."


def _camera(view: "View", name: str) -> str:

    found = [k for k in view.cameras if name in (k, k.rsplit(".", 1)[-1])]
    if len(found) != 1:
        raise ConfigError(one_of("camera", name, view.cameras))
    return found[0]
