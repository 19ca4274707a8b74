// What Python asks the library itself, beside the operators of register.cc.
#include <cstdlib>

#include "correlation.h"
#include "refine.h"

// The name of the instruction set that sessions would use now, or null where EDGE_NATIVE_ISA names
// one that this machine does not run.
EDGE_EXPORT const char* EdgeStereoInstructionSet() {
  const edge::Kernels* kernels = edge::SelectKernels(std::getenv(edge::kInstructionSet));
  return kernels != nullptr ? kernels->name : nullptr;
}

// Refines the depths of a frame's boxes in place, see refine.h.
EDGE_EXPORT void EdgeRefineDepths(const edge::RefineFrame* frame, const edge::RefineRules* rules) {
  edge::RefineDepths(*frame, *rules);
}
