// The Python interface of the rasterizer, which fills arrays in place, and the choice of the instruction set for all
// kernels. The types that Python sees are in _rasterizer.pyi.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>
#include <string>

#include "rasterizer.h"
#include "rows/rows.h"

namespace nb = nanobind;
using Array = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Strided = nb::ndarray<const float, nb::device::cpu>;

namespace {

struct Kernel {
  std::string name;
  decltype(&obbgs::portable::project) project;
  decltype(&obbgs::portable::bin) bin;
  decltype(&obbgs::portable::composite) composite;
  decltype(&obbgs::portable::composite_backward) composite_backward;
  decltype(&obbgs::portable::project_backward) project_backward;
  const obbgs::RowLoops* row_loops;
};
#define OBBGS_KERNEL(name)          \
  {#name,                           \
   obbgs::name::project,            \
   obbgs::name::bin,                \
   obbgs::name::composite,          \
   obbgs::name::composite_backward, \
   obbgs::name::project_backward,   \
   &obbgs::name::row_loops}

std::vector<Kernel> available_kernels() {  // best first
  std::vector<Kernel> kernels;
#ifdef KERNELS_X86
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512bw"))
    kernels.push_back(OBBGS_KERNEL(avx512));
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
      __builtin_cpu_supports("bmi2"))
    kernels.push_back(OBBGS_KERNEL(avx2));
#endif
  kernels.push_back(OBBGS_KERNEL(portable));
  return kernels;
}

Kernel kernel_called(const std::string& name) {
  std::string known;
  for (const Kernel& kernel : available_kernels()) {
    if (kernel.name == name) return kernel;
    known += (known.empty() ? "" : ", ") + kernel.name;
  }
  throw std::invalid_argument("this processor runs the kernels " + known + ", not '" + name + "'");
}

float* data_of(const Array& array, const char* name, size_t count) {
  if (array.size() != count)
    throw std::invalid_argument(std::string(name) + ": expected " + std::to_string(count) + " numbers, got " +
                                std::to_string(array.size()));
  return array.data();
}

// A rendering of Gaussians by cameras of one size: once forward, then backward any number of times.
class Rasterization {
 public:
  Rasterization(const std::string& kernel, int width, int height, float near_m, Array means, Array quats,
                Array log_scales, Array opacity_logits, Array sh, Array world_to_camera, Array K,
                std::optional<Array> sun_dir, std::optional<Array> sunlit, float ambient, std::optional<Array> added,
                Array footprint_px2, bool peak_lowered)
      : kernel_(kernel_called(kernel)),
        arrays_{means, quats, log_scales, opacity_logits, sh, world_to_camera, K, footprint_px2} {
    if (sun_dir) arrays_.push_back(*sun_dir);
    if (sunlit) arrays_.push_back(*sunlit);
    if (added) arrays_.push_back(*added);
    const size_t n = opacity_logits.size(), cameras = world_to_camera.size() / 16;
    const size_t coefficients = sh.ndim() == 3 ? sh.shape(1) : 0, channels = sh.ndim() == 3 ? sh.shape(2) : 0;
    if (width < 1 || height < 1 || width > 16384 || height > 16384)
      throw std::invalid_argument("width and height must be 1 to 16384");
    if (coefficients != 1 && coefficients != 4 && coefficients != 9 && coefficients != 16)
      throw std::invalid_argument("expected 1, 4, 9 or 16 coefficients, got " + std::to_string(coefficients));
    if (channels != 1 && channels != 3)
      throw std::invalid_argument("expected 1 or 3 channels, got " + std::to_string(channels));
    if (sunlit && !sun_dir) throw std::invalid_argument("sunlit needs sun_dir");
    if (n * cameras > size_t(INT32_MAX)) throw std::invalid_argument("2^31 or more Gaussians times cameras");
    scene_ = {int(n),
              int(cameras),
              int(coefficients),
              int(channels),
              width,
              height,
              near_m,
              data_of(means, "means", 3 * n),
              data_of(quats, "quats", 4 * n),
              data_of(log_scales, "log_scales", 3 * n),
              opacity_logits.data(),
              data_of(sh, "sh", n * coefficients * channels),
              data_of(world_to_camera, "world_to_camera", 16 * cameras),
              data_of(K, "K", 9 * cameras),
              sun_dir ? data_of(*sun_dir, "sun_dir", 3 * cameras) : nullptr,
              sunlit ? data_of(*sunlit, "sunlit", n * cameras) : nullptr,
              ambient,
              added ? data_of(*added, "added", n * cameras * channels) : nullptr,
              data_of(footprint_px2, "footprint_px2", cameras),
              peak_lowered};
  }

  void forward(int threads, Array radiance, Array alpha, Array depth, Array median_depth, Array means2d, Array radii) {
    const size_t splats = size_t(scene_.cameras) * scene_.gaussians;
    const obbgs::Images images = images_of(radiance, alpha, depth, median_depth);
    float *to_means2d = data_of(means2d, "means2d", 2 * splats), *to_radii = data_of(radii, "radii", splats);
    nb::gil_scoped_release release;
    kernel_.project(scene_, frame_, to_means2d, to_radii, threads);
    kernel_.bin(scene_, frame_, threads);
    kernel_.composite(scene_, frame_, images, threads);
  }

  void backward(int threads, Array radiance, Array depth, std::optional<Strided> grad_radiance,
                std::optional<Strided> grad_alpha, std::optional<Strided> grad_depth, std::optional<Array> grad_means2d,
                Array means, Array quats, Array log_scales, Array opacity_logits, Array sh, Array world_to_camera,
                Array ambient, Array footprint_px2, std::optional<Array> added, Array screen_means2d,
                Array pixels) const {
    const obbgs::Scene& s = scene_;
    if (!frame_.tile_begin.size()) throw std::logic_error("backward before forward");
    const size_t n = s.gaussians, splats = n * s.cameras;
    const obbgs::Images images = images_of(radiance, depth, depth, depth);
    const obbgs::ImageGradients g{gradient_of(grad_radiance, s.channels), gradient_of(grad_alpha, 0),
                                  gradient_of(grad_depth, 0)};
    const obbgs::SceneGradients out{grad_means2d ? data_of(*grad_means2d, "grad_means2d", 2 * splats) : nullptr,
                                    data_of(means, "means", 3 * n),
                                    data_of(quats, "quats", 4 * n),
                                    data_of(log_scales, "log_scales", 3 * n),
                                    data_of(opacity_logits, "opacity_logits", n),
                                    data_of(sh, "sh", n * s.sh_count * s.channels),
                                    data_of(world_to_camera, "world_to_camera", 16 * size_t(s.cameras)),
                                    data_of(ambient, "ambient", 1),
                                    data_of(footprint_px2, "footprint_px2", s.cameras),
                                    added ? data_of(*added, "added", splats * s.channels) : nullptr,
                                    data_of(screen_means2d, "screen_means2d", 2 * splats),
                                    data_of(pixels, "pixels", splats)};
    nb::gil_scoped_release release;
    struct alignas(64) Record {
      float sums[obbgs::kRecord];
    };
    obbgs::Buffer<Record> records;
    records.resize(frame_.pairs.size());
    float* sums = reinterpret_cast<float*>(records.data());
    kernel_.composite_backward(s, frame_, images, g, sums, threads);
    kernel_.project_backward(s, frame_, sums, g.features(s), out, threads);
  }

  size_t pairs() const { return frame_.pairs.size(); }
  size_t bytes() const {  // the peak memory of the backward pass, without the caller's arrays
    const size_t records = frame_.pairs.size() * obbgs::kRecord * sizeof(float);
    return records + frame_.splats.bytes() + frame_.visible.bytes() + frame_.tile_begin.bytes() + frame_.pairs.bytes() +
           frame_.transmittance.bytes();
  }

 private:
  obbgs::Images images_of(const Array& radiance, const Array& alpha, const Array& depth,
                          const Array& median_depth) const {
    const size_t pixels = size_t(scene_.cameras) * scene_.width * scene_.height;
    return {data_of(radiance, "radiance", pixels * scene_.channels), data_of(alpha, "alpha", pixels),
            data_of(depth, "depth", pixels), data_of(median_depth, "median_depth", pixels)};
  }

  // A gradient of shape [cameras, height, width] or, with channels, [cameras, height, width, channels]; any strides.
  obbgs::ImageGradient gradient_of(const std::optional<Strided>& array, int channels) const {
    obbgs::ImageGradient g;
    if (!array) return g;
    const size_t shape[4] = {size_t(scene_.cameras), size_t(scene_.height), size_t(scene_.width), size_t(channels)};
    const size_t ndim = channels ? 4 : 3;
    bool same = array->ndim() == ndim;
    for (size_t i = 0; same && i < ndim; ++i) same = array->shape(i) == shape[i];
    if (!same) throw std::invalid_argument("an image gradient must have the shape of its image");
    g.data = array->data();
    for (size_t i = 0; i < ndim; ++i) g.stride[i] = array->stride(i);
    return g;
  }

  Kernel kernel_;
  std::vector<Array> arrays_;  // own the memory that scene_ points to
  obbgs::Scene scene_;
  obbgs::Frame frame_;
};

}  // namespace

void bind_likelihood(nb::module_& m);  // likelihood.cpp
void bind_training(nb::module_& m);    // training.cpp

NB_MODULE(_rasterizer, m) {
  nb::set_leak_warnings(false);  // autograd graphs that live until Python ends keep their renderings; that is no leak
  m.attr("MIN_ALPHA") = obbgs::kMinAlpha;
  m.attr("LOG2_MIN_ALPHA") = obbgs::kLog2MinAlpha;
  m.attr("MAX_ALPHA") = obbgs::kMaxAlpha;
  m.attr("MIN_TRANSMITTANCE") = obbgs::kMinTransmittance;
  m.attr("MIN_PEAK_SHARE") = obbgs::kMinPeakShare;
  m.attr("MIN_DEPTH_ALPHA") = obbgs::kMinDepthAlpha;
  m.attr("FOV_MARGIN") = obbgs::kFovMargin;
  m.attr("SOFTNESS") = obbgs::kSoftness;
  m.def("kernels", [] {
    std::vector<std::string> names;
    for (const Kernel& k : available_kernels()) names.push_back(k.name);
    return names;
  });
  m.def(
      "use_kernel", [](const std::string& name) { obbgs::use_row_loops(*kernel_called(name).row_loops); },
      nb::arg("name"), "Run the losses and Adam with this kernel from now on; by default they run with the best.");
  obbgs::use_row_loops(*available_kernels().front().row_loops);
  nb::class_<Rasterization>(m, "Rasterization")
      .def(nb::init<const std::string&, int, int, float, Array, Array, Array, Array, Array, Array, Array,
                    std::optional<Array>, std::optional<Array>, float, std::optional<Array>, Array, bool>(),
           nb::arg("kernel"), nb::arg("width"), nb::arg("height"), nb::arg("near_m"), nb::arg("means"),
           nb::arg("quats"), nb::arg("log_scales"), nb::arg("opacity_logits"), nb::arg("sh"),
           nb::arg("world_to_camera"), nb::arg("K"), nb::arg("sun_dir").none(), nb::arg("sunlit").none(),
           nb::arg("ambient"), nb::arg("added").none(), nb::arg("footprint_px2"), nb::arg("peak_lowered"))
      .def("forward", &Rasterization::forward, nb::arg("threads"), nb::arg("radiance"), nb::arg("alpha"),
           nb::arg("depth"), nb::arg("median_depth"), nb::arg("means2d"), nb::arg("radii"))
      .def("backward", &Rasterization::backward, nb::arg("threads"), nb::arg("radiance"), nb::arg("depth"),
           nb::arg("grad_radiance").none(), nb::arg("grad_alpha").none(), nb::arg("grad_depth").none(),
           nb::arg("grad_means2d").none(), nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"),
           nb::arg("opacity_logits"), nb::arg("sh"), nb::arg("world_to_camera"), nb::arg("ambient"),
           nb::arg("footprint_px2"), nb::arg("added").none(), nb::arg("screen_means2d"), nb::arg("pixels"))
      .def_prop_ro("pairs", &Rasterization::pairs)
      .def_prop_ro("bytes", &Rasterization::bytes);
  bind_likelihood(m);
  bind_training(m);
}
