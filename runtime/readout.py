"""From a network's outputs to a frame's boxes: decoded, their depths refined and their scores told by those depths.

The one path of runtime, measurement and validation while training, whatever computed the outputs.
"""

from __future__ import annotations

from runtime.boxcode import FloatArray32
from runtime.contracts.errors import FrameError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.manifest import AnchorPriors, Manifest
from runtime.contracts.objects import Detections3D
from runtime.decode import Decoder
from runtime.preprocess import NetworkView
from runtime.refinement import OCCLUDER_SCORE, Refined, check_confidence, refiner, with_confidence


class Readout:
    """Reads boxes out of one model's outputs, in two steps that can be timed.

    Args:
        manifest: thresholds, suppression, whether depths are refined, and what scores follow from that.
        priors: of the model.
        use_native: thin candidates and refine depths by the native library where it was built.

    Raises:
        ManifestError: the manifest's confidence does not fit.
    """

    def __init__(self, manifest: Manifest, priors: AnchorPriors, *, use_native: bool = True) -> None:
        check_confidence(manifest.confidence, manifest.classes)
        self._manifest = manifest
        self._refine = refiner(use_native=use_native)
        self._decoder = Decoder(manifest, priors, use_native=use_native)

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

    def look(self, decoded: Detections3D, frame: StereoFrame) -> Refined:
        """What `decode` gave, with its final depths, the network's scores, and what was learned of the match."""
        if frame.right is None:
            raise FrameError(
                f"frame {frame.frame_id} has no right image, expected a pair to refine depths by; use a stereo source"
            )
        return self._refine(decoded, frame.left, frame.right, frame.geometry)

    def refine(self, decoded: Detections3D, frame: StereoFrame, *, score: float | None = None) -> Detections3D:
        """What `decode` gave for the same score, with its final depths and scores, without what has a lower one."""
        if not self._manifest.depth_refinement:
            return decoded
        if frame.right is not None:
            refined = self.look(decoded, frame)
            decoded = with_confidence(refined, self._manifest.confidence, frame.left.shape[1])
        return decoded.select(decoded.score > self._least(score))

    def _least(self, score: float | None) -> float:
        return self._manifest.thresholds.evaluate if score is None else score
