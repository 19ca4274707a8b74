// The part of ONNX Runtime's C interface that the operators need, declared by us.
//
// OrtApi is a table of function pointers to which every release only appends, so a function is
// known by its place. The places below are those of API version 18 (onnxruntime 1.18 and newer); a
// test loads the library into the installed onnxruntime and compares results, which guards them.
#ifndef EDGE_STEREO_ORT_API_H_
#define EDGE_STEREO_ORT_API_H_

#include <cstddef>
#include <cstdint>

namespace edge {

constexpr uint32_t kOrtApiVersion = 18;

// Opaque objects of ONNX Runtime.
struct OrtStatus;
struct OrtSessionOptions;
struct OrtCustomOpDomain;
struct OrtKernelInfo;
struct OrtKernelContext;
struct OrtShapeInferContext;
struct OrtTensorTypeAndShapeInfo;
struct OrtOpAttr;
struct OrtValue;

enum ElementType : int { kUndefined = 0, kFloat = 1, kUint8 = 2, kInt8 = 3 };
enum ErrorCode : int { kFail = 1, kInvalidArgument = 2 };
enum AttributeType : int { kAttributeInt = 1 };
enum Characteristic : int { kRequired = 0 };
enum MemoryType : int { kDefaultMemory = 0 };

struct OrtApiBase {
  const void* (*GetApi)(uint32_t version);
  const char* (*GetVersionString)();
};

// The operator, as ONNX Runtime asks it questions: 26 slots.
struct OrtCustomOp {
  uint32_t version;
  void* (*CreateKernel)(const OrtCustomOp*, const void* api, const OrtKernelInfo*);
  const char* (*GetName)(const OrtCustomOp*);
  const char* (*GetExecutionProviderType)(const OrtCustomOp*);
  ElementType (*GetInputType)(const OrtCustomOp*, size_t);
  size_t (*GetInputTypeCount)(const OrtCustomOp*);
  ElementType (*GetOutputType)(const OrtCustomOp*, size_t);
  size_t (*GetOutputTypeCount)(const OrtCustomOp*);
  void (*KernelCompute)(void* kernel, OrtKernelContext*);
  void (*KernelDestroy)(void* kernel);
  Characteristic (*GetInputCharacteristic)(const OrtCustomOp*, size_t);
  Characteristic (*GetOutputCharacteristic)(const OrtCustomOp*, size_t);
  MemoryType (*GetInputMemoryType)(const OrtCustomOp*, size_t);
  int (*GetVariadicInputMinArity)(const OrtCustomOp*);
  int (*GetVariadicInputHomogeneity)(const OrtCustomOp*);
  int (*GetVariadicOutputMinArity)(const OrtCustomOp*);
  int (*GetVariadicOutputHomogeneity)(const OrtCustomOp*);
  OrtStatus* (*CreateKernelV2)(const OrtCustomOp*, const void* api, const OrtKernelInfo*,
                               void** kernel);
  OrtStatus* (*KernelComputeV2)(void* kernel, OrtKernelContext*);
  OrtStatus* (*InferOutputShape)(const OrtCustomOp*, OrtShapeInferContext*);
  int (*GetStartVersion)(const OrtCustomOp*);
  int (*GetEndVersion)(const OrtCustomOp*);
  size_t (*GetMayInplace)(int** inputs, int** outputs);
  void (*ReleaseMayInplace)(int* inputs, int* outputs);
  size_t (*GetAliasMap)(int** inputs, int** outputs);
  void (*ReleaseAliasMap)(int* inputs, int* outputs);
};
static_assert(sizeof(OrtCustomOp) == 208, "OrtCustomOp of API version 18 has 26 slots");
static_assert(offsetof(OrtCustomOp, CreateKernelV2) == 136, "slot 17");
static_assert(offsetof(OrtCustomOp, InferOutputShape) == 152, "slot 19");

// The table, by name. Every function but the two Release ones returns null or an error to hand on.
class OrtApi {
 public:
  explicit OrtApi(const void* table) : slots_(static_cast<void* const*>(table)) {}

  OrtStatus* CreateStatus(ErrorCode code, const char* message) const {
    return At<OrtStatus*(int, const char*)>(0)(code, message);
  }
  OrtStatus* CreateCustomOpDomain(const char* name, OrtCustomOpDomain** domain) const {
    return At<OrtStatus*(const char*, OrtCustomOpDomain**)>(26)(name, domain);
  }
  OrtStatus* AddToDomain(OrtCustomOpDomain* domain, const OrtCustomOp* op) const {
    return At<OrtStatus*(OrtCustomOpDomain*, const OrtCustomOp*)>(27)(domain, op);
  }
  OrtStatus* AddDomain(OrtSessionOptions* options, OrtCustomOpDomain* domain) const {
    return At<OrtStatus*(OrtSessionOptions*, OrtCustomOpDomain*)>(28)(options, domain);
  }
  OrtStatus* GetTensorMutableData(OrtValue* value, void** data) const {
    return At<OrtStatus*(OrtValue*, void**)>(51)(value, data);
  }
  OrtStatus* CreateInfo(OrtTensorTypeAndShapeInfo** info) const {
    return At<OrtStatus*(OrtTensorTypeAndShapeInfo**)>(57)(info);
  }
  OrtStatus* SetElementType(OrtTensorTypeAndShapeInfo* info, ElementType type) const {
    return At<OrtStatus*(OrtTensorTypeAndShapeInfo*, int)>(58)(info, type);
  }
  OrtStatus* SetDimensions(OrtTensorTypeAndShapeInfo* info, const int64_t* dims,
                           size_t count) const {
    return At<OrtStatus*(OrtTensorTypeAndShapeInfo*, const int64_t*, size_t)>(59)(info, dims,
                                                                                  count);
  }
  OrtStatus* GetElementType(const OrtTensorTypeAndShapeInfo* info, ElementType* type) const {
    return At<OrtStatus*(const OrtTensorTypeAndShapeInfo*, ElementType*)>(60)(info, type);
  }
  OrtStatus* GetDimensionCount(const OrtTensorTypeAndShapeInfo* info, size_t* count) const {
    return At<OrtStatus*(const OrtTensorTypeAndShapeInfo*, size_t*)>(61)(info, count);
  }
  OrtStatus* GetDimensions(const OrtTensorTypeAndShapeInfo* info, int64_t* dims,
                           size_t count) const {
    return At<OrtStatus*(const OrtTensorTypeAndShapeInfo*, int64_t*, size_t)>(62)(info, dims,
                                                                                  count);
  }
  OrtStatus* GetTensorInfo(const OrtValue* value, OrtTensorTypeAndShapeInfo** info) const {
    return At<OrtStatus*(const OrtValue*, OrtTensorTypeAndShapeInfo**)>(65)(value, info);
  }
  OrtStatus* GetAttribute(const OrtKernelInfo* info, const char* name, int64_t* value) const {
    return At<OrtStatus*(const OrtKernelInfo*, const char*, int64_t*)>(86)(info, name, value);
  }
  OrtStatus* GetInput(const OrtKernelContext* context, size_t index, const OrtValue** value) const {
    return At<OrtStatus*(const OrtKernelContext*, size_t, const OrtValue**)>(90)(context, index,
                                                                                 value);
  }
  OrtStatus* GetOutput(OrtKernelContext* context, size_t index, const int64_t* dims, size_t count,
                       OrtValue** value) const {
    return At<OrtStatus*(OrtKernelContext*, size_t, const int64_t*, size_t, OrtValue**)>(91)(
        context, index, dims, count, value);
  }
  void ReleaseInfo(OrtTensorTypeAndShapeInfo* info) const {
    At<void(OrtTensorTypeAndShapeInfo*)>(99)(info);
  }
  OrtStatus* GetInputInfo(const OrtShapeInferContext* context, size_t index,
                          OrtTensorTypeAndShapeInfo** info) const {
    return At<OrtStatus*(const OrtShapeInferContext*, size_t, OrtTensorTypeAndShapeInfo**)>(268)(
        context, index, info);
  }
  OrtStatus* GetAttribute(const OrtShapeInferContext* context, const char* name,
                          const OrtOpAttr** attribute) const {
    return At<OrtStatus*(const OrtShapeInferContext*, const char*, const OrtOpAttr**)>(269)(
        context, name, attribute);
  }
  OrtStatus* SetOutputInfo(const OrtShapeInferContext* context, size_t index,
                           const OrtTensorTypeAndShapeInfo* info) const {
    return At<OrtStatus*(const OrtShapeInferContext*, size_t, const OrtTensorTypeAndShapeInfo*)>(
        270)(context, index, info);
  }
  OrtStatus* ReadInt(const OrtOpAttr* attribute, int64_t* value) const {
    size_t written = 0;
    return At<OrtStatus*(const OrtOpAttr*, int, void*, size_t, size_t*)>(272)(
        attribute, kAttributeInt, value, sizeof(*value), &written);
  }
  // Calls work(data, i) for i in [0, count) on ONNX Runtime's own threads and waits for them.
  OrtStatus* ParallelFor(const OrtKernelContext* context, void (*work)(void*, size_t), size_t count,
                         void* data) const {
    return At<OrtStatus*(const OrtKernelContext*, void (*)(void*, size_t), size_t, size_t, void*)>(
        274)(context, work, count, 0, data);
  }

 private:
  template <class Function>
  Function* At(size_t place) const {
    return reinterpret_cast<Function*>(slots_[place]);
  }

  void* const* slots_;
};

}  // namespace edge

#endif  // EDGE_STEREO_ORT_API_H_
