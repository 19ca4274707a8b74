// AVX-512 with VNNI, which multiplies two channels and adds them to the sum in one instruction.
#include "vector_avx512.h"

namespace edge {

const Kernels kVnniKernels = {"vnni", CorrelateFloatRows<Avx512Float>,
                              CorrelateQuantizedRows<Avx512Quantized>};

}  // namespace edge
