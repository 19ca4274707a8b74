// Makes the two correlation operators known to ONNX Runtime.
#include <atomic>
#include <cmath>
#include <cstdlib>
#include <mutex>
#include <new>

#include "correlation.h"
#include "ort_api.h"

#define EDGE_RETURN_IF_ERROR(call)                       \
  do {                                                   \
    if (edge::OrtStatus* status = (call)) return status; \
  } while (false)

namespace edge {
namespace {

constexpr char kDomain[] = "edge.stereo";
constexpr char kAttribute[] = "max_disparity";
constexpr int64_t kRowsPerTask = 4;

constexpr size_t kFloatInputs = 2;
constexpr size_t kQuantizedInputs = 8;
// Inputs of the quantized operator: each tensor is followed by its scale and zero point.
constexpr size_t kLeft = 0, kRight = 3, kOutputScale = 6, kOutputZeroPoint = 7;

struct Kernel {
  OrtApi api;
  const Kernels* kernels;
  int64_t disparities;
};

struct Tensor {
  void* data = nullptr;
  ElementType type = kUndefined;
  size_t rank = 0;
  int64_t dims[4] = {0, 0, 0, 0};
};

OrtStatus* ReadInput(const OrtApi& api, const OrtKernelContext* context, size_t index,
                     Tensor* tensor) {
  const OrtValue* value = nullptr;
  EDGE_RETURN_IF_ERROR(api.GetInput(context, index, &value));
  OrtTensorTypeAndShapeInfo* info = nullptr;
  EDGE_RETURN_IF_ERROR(api.GetTensorInfo(value, &info));
  OrtStatus* status = api.GetElementType(info, &tensor->type);
  if (status == nullptr) status = api.GetDimensionCount(info, &tensor->rank);
  if (status == nullptr && tensor->rank <= 4)
    status = api.GetDimensions(info, tensor->dims, tensor->rank);
  api.ReleaseInfo(info);
  if (status != nullptr) return status;
  return api.GetTensorMutableData(const_cast<OrtValue*>(value), &tensor->data);
}

OrtStatus* CheckViews(const OrtApi& api, const Tensor& left, const Tensor& right) {
  bool same = left.rank == 4 && right.rank == 4 && left.dims[1] > 0;
  for (size_t i = 0; same && i < 4; ++i) same = left.dims[i] == right.dims[i];
  if (same) return nullptr;
  return api.CreateStatus(
      kInvalidArgument, "stereo correlation: left and right must both be [B, C, H, W] with C >= 1");
}

OrtStatus* MakeOutput(const OrtApi& api, OrtKernelContext* context, const Shape& shape,
                      void** data) {
  const int64_t dims[] = {shape.batch, shape.disparities, shape.height, shape.width};
  OrtValue* value = nullptr;
  EDGE_RETURN_IF_ERROR(api.GetOutput(context, 0, dims, 4, &value));
  return api.GetTensorMutableData(value, data);
}

// Spreads the rows over ONNX Runtime's threads. Rows is called with (first, last, scratch).
template <class Rows>
OrtStatus* ForAllRows(const OrtApi& api, const OrtKernelContext* context, const Shape& shape,
                      const Rows& rows) {
  struct Work {
    const Rows& rows;
    int64_t row_count;
    size_t scratch_bytes;
    std::atomic<bool> out_of_memory;
  } work = {rows, shape.batch * shape.height, ScratchBytes(shape), {false}};
  if (work.row_count * shape.width == 0) return nullptr;

  const auto task = [](void* data, size_t index) {
    Work& of = *static_cast<Work*>(data);
    void* scratch = std::aligned_alloc(kScratchAlignment, of.scratch_bytes);
    if (scratch == nullptr) {
      of.out_of_memory = true;
      return;
    }
    const int64_t first = static_cast<int64_t>(index) * kRowsPerTask;
    const int64_t end = first + kRowsPerTask;
    of.rows(first, end < of.row_count ? end : of.row_count, scratch);
    std::free(scratch);
  };
  const int64_t tasks = (work.row_count + kRowsPerTask - 1) / kRowsPerTask;
  EDGE_RETURN_IF_ERROR(api.ParallelFor(context, task, static_cast<size_t>(tasks), &work));
  if (!work.out_of_memory) return nullptr;
  return api.CreateStatus(kFail, "stereo correlation: out of memory");
}

OrtStatus* ComputeFloat(void* self, OrtKernelContext* context) {
  const Kernel& kernel = *static_cast<Kernel*>(self);
  Tensor left, right;
  EDGE_RETURN_IF_ERROR(ReadInput(kernel.api, context, 0, &left));
  EDGE_RETURN_IF_ERROR(ReadInput(kernel.api, context, 1, &right));
  EDGE_RETURN_IF_ERROR(CheckViews(kernel.api, left, right));
  const Shape shape = {left.dims[0], left.dims[1], left.dims[2], left.dims[3], kernel.disparities};
  void* volume = nullptr;
  EDGE_RETURN_IF_ERROR(MakeOutput(kernel.api, context, shape, &volume));
  return ForAllRows(kernel.api, context, shape, [&](int64_t first, int64_t last, void* scratch) {
    kernel.kernels->float_rows(static_cast<const float*>(left.data),
                               static_cast<const float*>(right.data), static_cast<float*>(volume),
                               shape, first, last, scratch);
  });
}

bool IsByte(ElementType type) { return type == kUint8 || type == kInt8; }

int32_t ByteValue(const Tensor& scalar) {
  return scalar.type == kInt8 ? *static_cast<const int8_t*>(scalar.data)
                              : *static_cast<const uint8_t*>(scalar.data);
}

bool IsScalar(const Tensor& tensor) {
  if (tensor.rank > 4) return false;
  int64_t count = 1;
  for (size_t i = 0; i < tensor.rank; ++i) count *= tensor.dims[i];
  return count == 1;
}

OrtStatus* CheckQuantized(const OrtApi& api, const Tensor* inputs) {
  EDGE_RETURN_IF_ERROR(CheckViews(api, inputs[kLeft], inputs[kRight]));
  bool fits = inputs[kLeft].dims[1] <= kMostQuantizedChannels;
  for (size_t tensor : {kLeft, kRight}) {
    fits = fits && IsByte(inputs[tensor].type) && inputs[tensor + 2].type == inputs[tensor].type;
  }
  for (size_t scale : {kLeft + 1, kRight + 1, kOutputScale}) {
    fits = fits && inputs[scale].type == kFloat && IsScalar(inputs[scale]) &&
           IsScalar(inputs[scale + 1]);
  }
  if (fits && IsByte(inputs[kOutputZeroPoint].type)) return nullptr;
  return api.CreateStatus(
      kInvalidArgument,
      "quantized stereo correlation: tensors must be uint8 or int8 with at most 33025"
      " channels, zero points scalars of their tensor's type, scales float scalars");
}

OrtStatus* ComputeQuantized(void* self, OrtKernelContext* context) {
  const Kernel& kernel = *static_cast<Kernel*>(self);
  Tensor inputs[kQuantizedInputs];
  for (size_t i = 0; i < kQuantizedInputs; ++i) {
    EDGE_RETURN_IF_ERROR(ReadInput(kernel.api, context, i, &inputs[i]));
  }
  EDGE_RETURN_IF_ERROR(CheckQuantized(kernel.api, inputs));
  const int64_t* dims = inputs[kLeft].dims;
  const Shape shape = {dims[0], dims[1], dims[2], dims[3], kernel.disparities};
  const auto scale = [&](size_t index) {
    return double{*static_cast<const float*>(inputs[index].data)};
  };
  const float multiplier =
      static_cast<float>(scale(kLeft + 1) * scale(kRight + 1) /
                         (static_cast<double>(shape.channels) * scale(kOutputScale)));
  if (!std::isfinite(multiplier)) {
    return kernel.api.CreateStatus(
        kInvalidArgument, "quantized stereo correlation: scales must be finite and not zero");
  }
  void* volume = nullptr;
  EDGE_RETURN_IF_ERROR(MakeOutput(kernel.api, context, shape, &volume));
  const auto view = [&](size_t index) {
    return QuantizedView{inputs[index].data, ByteValue(inputs[index + 2]),
                         inputs[index].type == kInt8};
  };
  const QuantizedView left = view(kLeft), right = view(kRight);
  const Tensor& zero_point = inputs[kOutputZeroPoint];
  const QuantizedOutput out = {volume, ByteValue(zero_point), zero_point.type == kInt8, multiplier};
  return ForAllRows(kernel.api, context, shape, [&](int64_t first, int64_t last, void* scratch) {
    kernel.kernels->quantized_rows(left, right, out, shape, first, last, scratch);
  });
}

OrtStatus* CreateKernel(const OrtCustomOp*, const void* table, const OrtKernelInfo* info,
                        void** kernel) {
  const OrtApi api(table);
  int64_t disparities = 0;
  EDGE_RETURN_IF_ERROR(api.GetAttribute(info, kAttribute, &disparities));
  if (disparities < 1) {
    return api.CreateStatus(kInvalidArgument,
                            "stereo correlation: max_disparity must be at least 1");
  }
  const Kernels* kernels = SelectKernels(std::getenv(kInstructionSet));
  if (kernels == nullptr) {
    return api.CreateStatus(
        kInvalidArgument,
        "stereo correlation: EDGE_NATIVE_ISA must be one of scalar, avx2, avx512, vnni, neon"
        " that this machine runs");
  }
  *kernel = new (std::nothrow) Kernel{api, kernels, disparities};
  return *kernel != nullptr ? nullptr
                            : api.CreateStatus(kFail, "stereo correlation: out of memory");
}

void DestroyKernel(void* kernel) { delete static_cast<Kernel*>(kernel); }

// An operator as registered: ONNX Runtime hands it back with each question.
struct Operator : OrtCustomOp {
  const void* table;
  const char* name;
  size_t input_count;
  size_t type_from;  // the input whose element type the volume has
};

const Operator& AsOperator(const OrtCustomOp* op) { return *static_cast<const Operator*>(op); }

// The volume has the views' extents but for D channels. Extents that are not known yet are -1.
OrtStatus* InferShape(const OrtCustomOp* op, OrtShapeInferContext* context) {
  const OrtApi api(AsOperator(op).table);
  OrtTensorTypeAndShapeInfo* view = nullptr;  // the context owns what it hands out
  EDGE_RETURN_IF_ERROR(api.GetInputInfo(context, 0, &view));
  int64_t dims[4] = {-1, -1, -1, -1};
  size_t rank = 0;
  EDGE_RETURN_IF_ERROR(api.GetDimensionCount(view, &rank));
  if (rank == 4) EDGE_RETURN_IF_ERROR(api.GetDimensions(view, dims, rank));
  const OrtOpAttr* attribute = nullptr;
  EDGE_RETURN_IF_ERROR(api.GetAttribute(context, kAttribute, &attribute));
  EDGE_RETURN_IF_ERROR(api.ReadInt(attribute, &dims[1]));
  OrtTensorTypeAndShapeInfo* typed = nullptr;
  EDGE_RETURN_IF_ERROR(api.GetInputInfo(context, AsOperator(op).type_from, &typed));
  ElementType type = kUndefined;
  EDGE_RETURN_IF_ERROR(api.GetElementType(typed, &type));

  OrtTensorTypeAndShapeInfo* volume = nullptr;
  EDGE_RETURN_IF_ERROR(api.CreateInfo(&volume));
  OrtStatus* status = api.SetElementType(volume, type);
  if (status == nullptr) status = api.SetDimensions(volume, dims, 4);
  if (status == nullptr) status = api.SetOutputInfo(context, 0, volume);
  api.ReleaseInfo(volume);
  return status;
}

ElementType FloatType(const OrtCustomOp*, size_t) { return kFloat; }

ElementType QuantizedInputType(const OrtCustomOp*, size_t index) {
  const bool scale = index == kLeft + 1 || index == kRight + 1 || index == kOutputScale;
  return scale ? kFloat : kUndefined;  // undefined: uint8 or int8, which the kernel checks
}

Operator MakeOperator(const char* name, size_t input_count, size_t type_from, const void* table) {
  Operator op = {};
  op.version = kOrtApiVersion;
  op.table = table;
  op.name = name;
  op.input_count = input_count;
  op.type_from = type_from;
  op.GetName = [](const OrtCustomOp* self) { return AsOperator(self).name; };
  op.GetExecutionProviderType = [](const OrtCustomOp*) -> const char* { return nullptr; };  // CPU
  op.GetInputTypeCount = [](const OrtCustomOp* self) { return AsOperator(self).input_count; };
  op.GetOutputTypeCount = [](const OrtCustomOp*) -> size_t { return 1; };
  op.GetInputCharacteristic = [](const OrtCustomOp*, size_t) { return kRequired; };
  op.GetOutputCharacteristic = [](const OrtCustomOp*, size_t) { return kRequired; };
  op.GetInputMemoryType = [](const OrtCustomOp*, size_t) { return kDefaultMemory; };
  op.CreateKernelV2 = CreateKernel;
  op.KernelDestroy = DestroyKernel;
  op.InferOutputShape = InferShape;
  op.GetStartVersion = [](const OrtCustomOp*) { return 1; };
  op.GetEndVersion = [](const OrtCustomOp*) { return 1; };
  return op;
}

// ONNX Runtime keeps pointers to the operators and the domain while a session lives, and several
// sessions may share them; so they are made once and stay.
OrtStatus* SharedDomain(const OrtApi& api, const void* table, OrtCustomOpDomain** shared) {
  static Operator float_op = [&] {
    Operator op = MakeOperator("StereoCorrelation", kFloatInputs, 0, table);
    op.GetInputType = FloatType;
    op.GetOutputType = FloatType;
    op.KernelComputeV2 = ComputeFloat;
    return op;
  }();
  static Operator quantized_op = [&] {
    Operator op =
        MakeOperator("QLinearStereoCorrelation", kQuantizedInputs, kOutputZeroPoint, table);
    op.GetInputType = QuantizedInputType;
    op.GetOutputType = [](const OrtCustomOp*, size_t) { return kUndefined; };
    op.KernelComputeV2 = ComputeQuantized;
    return op;
  }();
  static OrtCustomOpDomain* domain = nullptr;
  static std::mutex mutex;
  const std::lock_guard<std::mutex> lock(mutex);
  if (domain == nullptr) {
    OrtCustomOpDomain* fresh = nullptr;
    EDGE_RETURN_IF_ERROR(api.CreateCustomOpDomain(kDomain, &fresh));
    EDGE_RETURN_IF_ERROR(api.AddToDomain(fresh, &float_op));
    EDGE_RETURN_IF_ERROR(api.AddToDomain(fresh, &quantized_op));
    domain = fresh;
  }
  *shared = domain;
  return nullptr;
}

}  // namespace
}  // namespace edge

// What SessionOptions.register_custom_ops_library looks for.
EDGE_EXPORT edge::OrtStatus* RegisterCustomOps(edge::OrtSessionOptions* options,
                                               const edge::OrtApiBase* base) {
  const void* table = base->GetApi(edge::kOrtApiVersion);
  if (table == nullptr) {
    // An older onnxruntime: the first version's table suffices to say so, where silence would let
    // the registration "succeed" without any operator.
    return edge::OrtApi(base->GetApi(1))
        .CreateStatus(edge::kFail, "edge.stereo needs onnxruntime 1.18 or newer");
  }
  const edge::OrtApi api(table);
  edge::OrtCustomOpDomain* domain = nullptr;
  EDGE_RETURN_IF_ERROR(edge::SharedDomain(api, table, &domain));
  return api.AddDomain(options, domain);
}
