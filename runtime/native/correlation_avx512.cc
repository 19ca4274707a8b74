// AVX-512 F and BW.
#include "vector_avx512.h"

namespace edge {

const Kernels kAvx512Kernels = {"avx512", CorrelateFloatRows<Avx512Float>,
                                CorrelateQuantizedRows<Avx512Quantized>};

}  // namespace edge
