// What Python asks the library itself, beside the operators of register.cc.
#include <cstdlib>

#include "candidates.h"
#include "correlation.h"
#include "refine.h"

// The name of the instruction set that sessions would use now, or null where EDGE_NATIVE_ISA names
// one that this machine does not run.
EDGE_EXPORT const char* EdgeStereoInstructionSet() {
  const edge::Kernels* kernels = edge::SelectKernels(std::getenv(edge::kInstructionSet));
  return kernels != nullptr ? kernels->name : nullptr;
}

// Refines the depths of a frame's boxes in place, see refine.h. False, and nothing done, where the
// caller's records are not as long as these: it was made for another build.
EDGE_EXPORT bool EdgeRefineDepths(const edge::RefineFrame* frame, int64_t frame_bytes,
                                  const edge::RefineRules* rules, int64_t rules_bytes) {
  if (frame_bytes != sizeof(*frame) || rules_bytes != sizeof(*rules)) return false;
  edge::RefineDepths(*frame, *rules);
  return true;
}

// Drops boxes that overlap a better one, see candidates.h. False as above.
EDGE_EXPORT bool EdgeSuppress(const edge::SuppressionFrame* frame, int64_t frame_bytes) {
  if (frame_bytes != sizeof(*frame)) return false;
  edge::Suppress(*frame);
  return true;
}

// What is kept becomes the mean of what agrees with it, see candidates.h. False as above.
EDGE_EXPORT bool EdgeVote(const edge::VotingFrame* frame, int64_t frame_bytes) {
  if (frame_bytes != sizeof(*frame)) return false;
  edge::Vote(*frame);
  return true;
}
