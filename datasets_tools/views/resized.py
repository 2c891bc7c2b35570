"""Views with other sizes of pictures."""

from dataclasses import dataclass, field
from typing import Any

from .episode import Camera
from .view import DerivedView

__all__ = ["Resized"]


@dataclass
class Resized(DerivedView):
    """With other picture sizes."""

    shapes: dict[str, Camera] = field(default_factory=dict)

    @property
    def cameras(self) -> dict[str, Camera]:
        """Crop and size of each camera's pictures."""
        return self.shapes

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """With the new shapes, (H, W, 3)."""
        names = ["height", "width", "channels"]
        new = {k: {"shape": (*c.size, 3), "names": names} for k, c in self.shapes.items() if c.size}
        return {k: {**f, **new.get(k, {})} for k, f in self.parent.features.items()}
