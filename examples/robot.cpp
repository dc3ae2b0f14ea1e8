// A robot's program: frames in, poses out, by a model exported with `jaxunshear export --batch 1`. Needs ONNX Runtime's headers and
// library alone; DIR is where these were unpacked.
//
//     g++ -std=c++17 -O2 -I DIR/include examples/robot.cpp -L DIR/lib -lonnxruntime -o robot
//     ./robot touch.onnx < frames.raw       # bytes of frames or prepared images, or float32 of pins, one after the other

#include <onnxruntime_cxx_api.h>

#include <cstdint>
#include <cstdio>
#include <exception>
#include <sstream>
#include <string>
#include <vector>

static std::vector<std::string> split(const std::string& text) {
    std::vector<std::string> words;
    std::stringstream stream(text);
    for (std::string word; std::getline(stream, word, ',');) words.push_back(word);
    return words;
}

static int run(const char* file) {
    Ort::Env env(ORT_LOGGING_LEVEL_WARNING, "robot");
    Ort::Session session(env, file, Ort::SessionOptions{});
    Ort::AllocatorWithDefaultOptions allocator;
    const auto known = session.GetModelMetadata().LookupCustomMetadataMapAllocated("names", allocator);
    const std::vector<std::string> names = split(known ? known.get() : "");  // such as edge_mm, edge_deg

    const auto input = session.GetInputNameAllocated(0, allocator);
    const auto described = session.GetInputTypeInfo(0);
    const auto given = described.GetTensorTypeAndShapeInfo();
    std::vector<int64_t> shape = given.GetShape();
    shape[0] = 1;  // one frame at a time, where the model takes any number
    size_t size = given.GetElementType() == ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8 ? 1 : sizeof(float);
    for (const int64_t side : shape) size *= static_cast<size_t>(side);

    std::vector<char> frame(size);
    const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    const char* const inputs[] = {input.get()};
    const char* const outputs[] = {"pose", "confidence"};
    while (std::fread(frame.data(), 1, size, stdin) == size) {  // a camera's, on a robot
        const auto tensor = Ort::Value::CreateTensor(
            memory, frame.data(), size, shape.data(), shape.size(), given.GetElementType());
        const auto found = session.Run(Ort::RunOptions{nullptr}, inputs, &tensor, 1, outputs, 2);
        const float* const pose = found[0].GetTensorData<float>();  // nan, with a confidence of 0, of a frame of no such sensor
        for (size_t i = 0; i < names.size(); ++i) std::printf("%s %.4f ", names[i].c_str(), pose[i]);
        std::printf("confidence %.4f\n", *found[1].GetTensorData<float>());
        std::fflush(stdout);
    }
    return 0;
}

int main(int count, char** words) {
    if (count != 2) return std::fprintf(stderr, "robot MODEL < FRAMES\n"), 2;
    try {
        return run(words[1]);
    } catch (const std::exception& error) {
        return std::fprintf(stderr, "robot: %s\n", error.what()), 2;
    }
}
