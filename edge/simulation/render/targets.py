"""The buffers that pictures are drawn into, and how they are read back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SHADOW_TEXELS = 2048
COVER_TEXELS = 512


class Targets:
    """All framebuffers of a renderer for one picture size."""

    def __init__(self, context: Any, size_wh: tuple[int, int]) -> None:
        self.size_wh = size_wh
        self._colour_texture = context.texture(size_wh, 4, dtype="f2")
        self.colour = context.framebuffer([self._colour_texture], context.depth_renderbuffer(size_wh))
        self._identity_texture = context.texture(size_wh, 2, dtype="i4")
        self.identity = context.framebuffer([self._identity_texture], context.depth_renderbuffer(size_wh))

        self.shadow_texture = context.depth_texture((SHADOW_TEXELS, SHADOW_TEXELS))
        self.shadow_texture.compare_func = "<="
        self.shadow_texture.filter = (context.LINEAR, context.LINEAR)
        self.shadow_texture.repeat_x = self.shadow_texture.repeat_y = False
        self.shadow = context.framebuffer(depth_attachment=self.shadow_texture)
        self.cover_texture = context.texture((COVER_TEXELS, COVER_TEXELS), 1, dtype="f2")
        self.cover_texture.filter = (context.LINEAR_MIPMAP_LINEAR, context.LINEAR)
        self.cover_texture.repeat_x = self.cover_texture.repeat_y = False
        self.cover = context.framebuffer([self.cover_texture], context.depth_renderbuffer((COVER_TEXELS, COVER_TEXELS)))

    def read_radiance(self) -> NDArray[np.float32]:
        """The colour buffer: (H, W, 3) float32."""
        width, height = self.size_wh
        halves = np.frombuffer(self._colour_texture.read(), np.float16).reshape(height, width, 4)
        return halves[..., :3].astype(np.float32)

    def read_identity(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Object ids (H, W) int32 and z-depth (H, W) float32, inf where nothing was drawn."""
        width, height = self.size_wh
        words = np.frombuffer(self._identity_texture.read(), np.int32).reshape(height, width, 2)
        depth_m = np.ascontiguousarray(words[..., 1]).view(np.float32).copy()
        depth_m[depth_m == 0.0] = np.inf
        return np.ascontiguousarray(words[..., 0]), depth_m

    def read_identity_window(self, box_xyxy: tuple[int, int, int, int]) -> NDArray[np.int32]:
        """Object ids of a window [x0, x1) x [y0, y1)."""
        x0, y0, x1, y1 = box_xyxy
        data = self.identity.read(viewport=(x0, y0, x1 - x0, y1 - y0), components=2, dtype="i4", alignment=1)
        return np.frombuffer(data, np.int32).reshape(y1 - y0, x1 - x0, 2)[..., 0]

    def release(self) -> None:
        """Free GPU memory."""
        for framebuffer in (self.colour, self.identity, self.shadow, self.cover):
            framebuffer.release()
        for texture in (
            self._colour_texture,
            self._identity_texture,
            self.shadow_texture,
            self.cover_texture,
        ):
            texture.release()
