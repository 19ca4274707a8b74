"""From a network's outputs to a frame's boxes: decoded, their depths refined where the manifest asks for it.

The one path of runtime, measurement and validation while training, whatever computed the outputs.
"""

from __future__ import annotations

from runtime.boxcode import FloatArray32
from runtime.contracts.frame import StereoFrame
from runtime.contracts.manifest import AnchorPriors, Manifest
from runtime.contracts.objects import Detections3D
from runtime.decode import Decoder
from runtime.preprocess import NetworkView
from runtime.refinement import OCCLUDER_SCORE, refiner


class Readout:
    """Reads boxes out of one model's outputs, in two steps that can be timed.

    Args:
        manifest: thresholds, suppression, and whether depths are refined.
        priors: of the model.
        use_native: refine depths by the native library where it was built.
    """

    def __init__(self, manifest: Manifest, priors: AnchorPriors, *, use_native: bool = True) -> None:
        self._manifest = manifest
        self._refine = refiner(use_native=use_native)
        self._decoder = Decoder(manifest, priors)

    def decode(
        self, cls_logits: FloatArray32, box_deltas: FloatArray32, view: NetworkView, *, score: float | None = None
    ) -> Detections3D:
        """Boxes for `refine`, by falling score, as `Decoder.decode` gives them.

        Where depths are refined they reach down at least to the score from which on a box hides others: with a higher
        ``score`` a box must get the depth that it has with a lower one.
        """
        least = self._least(score)
        if self._manifest.depth_refinement:
            least = min(least, OCCLUDER_SCORE)
        return self._decoder.decode(cls_logits, box_deltas, view, score=least)

    def refine(self, decoded: Detections3D, frame: StereoFrame, *, score: float | None = None) -> Detections3D:
        """What `decode` gave for the same score, with its final depths and without what only hid others."""
        if self._manifest.depth_refinement and frame.right is not None:
            decoded = self._refine(decoded, frame.left, frame.right, frame.geometry)
        least = self._least(score)
        return decoded.select(decoded.score > least) if least > OCCLUDER_SCORE else decoded

    def _least(self, score: float | None) -> float:
        return self._manifest.thresholds.evaluate if score is None else score
