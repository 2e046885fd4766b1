// Denoises OpenEXR frames with a step that `jaxdn export` wrote, in ONNX Runtime:
//
//   denoise METHOD.onnx NOISY_LAYER OUT_FOLDER FRAME.exr...
//
// Compile it with OpenEXR 3 and ONNX Runtime 1.20 or newer:
//
//   g++ -std=c++17 -O2 denoise.cpp -o denoise $(pkg-config --cflags --libs OpenEXR) -lonnxruntime
//
// NOISY_LAYER is the layer of the noisy image ("noisy_1spp" in clips of jaxdn, "" for the channels R, G, B). The other
// buffers have the names that the model's metadata gives. Frames are consecutive: the state goes from one to the next.

#include <ImfChannelList.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfInputFile.h>
#include <ImfOutputFile.h>
#include <onnxruntime_cxx_api.h>

#include <filesystem>
#include <iostream>
#include <iterator>
#include <map>
#include <numeric>
#include <sstream>

using Shape = std::vector<int64_t>;

// The named channels of a file, interleaved: [height, width, channels].
std::vector<float> read(Imf::InputFile& file, const std::vector<std::string>& names) {
  const Imath::Box2i box = file.header().dataWindow();
  const int64_t width = box.max.x - box.min.x + 1, height = box.max.y - box.min.y + 1, count = names.size();
  std::vector<float> values(height * width * count);
  Imf::FrameBuffer buffer;
  for (int64_t i = 0; i < count; i++) {
    if (!file.header().channels().findChannel(names[i])) throw std::runtime_error("no channel " + names[i]);
    char* origin = reinterpret_cast<char*>(values.data() + i - (box.min.x + box.min.y * width) * count);
    buffer.insert(names[i], Imf::Slice(Imf::FLOAT, origin, 4 * count, 4 * count * width));
  }
  file.setFrameBuffer(buffer);
  file.readPixels(box.min.y, box.max.y);
  return values;
}

void write(const std::string& path, const float* image, int64_t height, int64_t width) {
  Imf::Header header(width, height);
  Imf::FrameBuffer buffer;
  for (int i = 0; i < 3; i++) {
    const std::string name(1, "RGB"[i]);
    header.channels().insert(name, Imf::Channel(Imf::FLOAT));
    char* origin = const_cast<char*>(reinterpret_cast<const char*>(image + i));
    buffer.insert(name, Imf::Slice(Imf::FLOAT, origin, 12, 12 * width));
  }
  Imf::OutputFile file(path.c_str(), header);
  file.setFrameBuffer(buffer);
  file.writePixels(height);
}

// A tensor of the values in the type that the model's input has.
Ort::Value tensor(const std::vector<float>& values, const Shape& shape, ONNXTensorElementDataType type) {
  Ort::AllocatorWithDefaultOptions memory;
  Ort::Value made = Ort::Value::CreateTensor(memory, shape.data(), shape.size(), type);
  auto fill = [&](auto* data) { std::copy(values.begin(), values.end(), data); };
  if (type == ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT) fill(made.GetTensorMutableData<float>());
  else if (type == ONNX_TENSOR_ELEMENT_DATA_TYPE_INT32) fill(made.GetTensorMutableData<int32_t>());
  else fill(made.GetTensorMutableData<bool>());
  return made;
}

int run(int count, char** arguments) {
  Ort::Env environment(ORT_LOGGING_LEVEL_ERROR);
  Ort::Session session(environment, arguments[1], Ort::SessionOptions());
  Ort::AllocatorWithDefaultOptions memory;
  const Ort::ModelMetadata about = session.GetModelMetadata();
  const std::vector<std::string> inputs = session.GetInputNames(), outputs = session.GetOutputNames();
  std::vector<const char*> input_names, output_names;
  for (const std::string& name : inputs) input_names.push_back(name.c_str());
  for (const std::string& name : outputs) output_names.push_back(name.c_str());
  std::map<std::string, Ort::Value> state;
  for (int frame = 4; frame < count; frame++) {
    Imf::InputFile file(arguments[frame]);
    const Imath::Box2i box = file.header().dataWindow();
    const int64_t width = box.max.x - box.min.x + 1, height = box.max.y - box.min.y + 1;
    std::vector<Ort::Value> given;
    for (size_t i = 0; i < inputs.size(); i++) {
      const std::string& name = inputs[i];
      const Ort::TypeInfo info = session.GetInputTypeInfo(i);
      const auto type = info.GetTensorTypeAndShapeInfo().GetElementType();
      Shape shape = info.GetTensorTypeAndShapeInfo().GetShape();
      if (shape.size() > 1) shape[0] = height, shape[1] = width;
      if (state.count(name)) {
        given.push_back(std::move(state.at(name)));
      } else if (name == "first" || name.rfind("state", 0) == 0) {  // a state before the first frame is all zeros
        const int64_t size = std::accumulate(shape.begin(), shape.end(), int64_t(1), std::multiplies<>());
        given.push_back(tensor(std::vector<float>(size, name == "first" && frame == 4), shape, type));
      } else {
        std::istringstream text(about.LookupCustomMetadataMapAllocated(("channels." + name).c_str(), memory).get());
        std::vector<std::string> channels(std::istream_iterator<std::string>(text), {});
        if (name == "radiance" && *arguments[2])
          for (std::string& one : channels) one = std::string(arguments[2]) + "." + one;
        std::vector<float> values = read(file, channels);
        if (name == "ids") for (float& value : values) value -= 1;  // in files nothing is 0, in the model -1
        given.push_back(tensor(values, shape, type));
      }
    }
    auto made = session.Run({}, input_names.data(), given.data(), given.size(), output_names.data(), outputs.size());
    const auto path = std::filesystem::path(arguments[3]) / std::filesystem::path(arguments[frame]).filename();
    write(path.string(), made[0].GetTensorData<float>(), height, width);
    state.clear();
    for (size_t i = 0; i < outputs.size(); i++)
      if (outputs[i].rfind("next", 0) == 0) state.emplace("state" + outputs[i].substr(4), std::move(made[i]));
  }
  return 0;
}

int main(int count, char** arguments) try {
  if (count < 5) throw std::runtime_error("usage: denoise METHOD.onnx NOISY_LAYER OUT_FOLDER FRAME.exr...");
  return run(count, arguments);
} catch (const std::exception& error) {
  std::cerr << "denoise: " << error.what() << "\n";
  return 2;
}
