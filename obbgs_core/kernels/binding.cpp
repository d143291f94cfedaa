// Python door to the rasterizer: arrays in, arrays filled in place, instruction set chosen at run time.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>
#include <string>

#include "rasterizer.h"

namespace nb = nanobind;
using obbgs::Bins;
using Array = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

namespace {

struct Kernel {
  std::string name;
  decltype(&obbgs::portable::forward) forward;
  decltype(&obbgs::portable::backward) backward;
};

std::vector<Kernel> available_kernels() {  // best first
  std::vector<Kernel> kernels;
#ifdef KERNELS_X86
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512bw"))
    kernels.push_back({"avx512", obbgs::avx512::forward, obbgs::avx512::backward});
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
    kernels.push_back({"avx2", obbgs::avx2::forward, obbgs::avx2::backward});
#endif
  kernels.push_back({"portable", obbgs::portable::forward, obbgs::portable::backward});
  return kernels;
}

void expect(const Array& array, const char* name, size_t count) {
  if (array.size() != count)
    throw std::invalid_argument(std::string(name) + ": expected " + std::to_string(count) + " numbers, got " +
                                std::to_string(array.size()));
}

class Rasterization {
 public:
  Rasterization(Array means2d, Array conics, Array opacities, Array depths, int width, int height, const std::string& kernel)
      : means2d_(means2d), conics_(conics), opacities_(opacities), depths_(depths), width_(width), height_(height) {
    const size_t n = depths.size();
    expect(means2d, "means2d", 2 * n);
    expect(conics, "conics", 3 * n);
    expect(opacities, "opacities", n);
    if (width < 1 || height < 1 || width > 16384 || height > 16384) throw std::invalid_argument("width and height must be 1 to 16384");
    for (const Kernel& k : available_kernels())
      if (kernel.empty() || kernel == k.name) { kernel_ = k; break; }
    if (!kernel_.forward) throw std::invalid_argument("no kernel " + kernel + " on this processor");
    splats_ = {int(n), means2d_.data(), conics_.data(), opacities_.data(), depths_.data()};
    nb::gil_scoped_release release;
    bins_ = obbgs::bin(splats_, width, height);
  }

  void forward(Array features, Array image, Array transmittance, Array median_depth, int threads) {
    const int count = feature_count(features);
    expect_images(count, image, transmittance, median_depth);
    const obbgs::Images out{image.data(), transmittance.data(), median_depth.data()};
    const float* f = features.data();
    nb::gil_scoped_release release;
    kernel_.forward(bins_, splats_, f, count, out, threads);
  }

  void backward(Array features, Array image, Array transmittance, Array grad_image, Array grad_transmittance,
                Array grad_means2d, Array grad_conics, Array grad_opacities, Array grad_features, Array pixels, int threads) {
    const int count = feature_count(features);
    expect_images(count, image, transmittance, transmittance);
    expect_images(count, grad_image, grad_transmittance, grad_transmittance);
    const size_t n = splats_.count;
    expect(grad_means2d, "grad_means2d", 2 * n);
    expect(grad_conics, "grad_conics", 3 * n);
    expect(grad_opacities, "grad_opacities", n);
    expect(grad_features, "grad_features", n * count);
    expect(pixels, "pixels", n);
    const obbgs::Images out{image.data(), transmittance.data(), nullptr};
    const obbgs::Gradients g{grad_image.data(), grad_transmittance.data(), grad_means2d.data(), grad_conics.data(),
                             grad_opacities.data(), grad_features.data(), pixels.data()};
    const float* f = features.data();
    nb::gil_scoped_release release;
    kernel_.backward(bins_, splats_, f, count, out, g, threads);
  }

  size_t pairs() const { return bins_.pairs.size(); }

 private:
  int feature_count(const Array& features) const {
    const size_t n = splats_.count;
    const int count = features.ndim() == 2 ? int(features.shape(1)) : 0;
    if (count < 1 || count > obbgs::kMaxFeatures || features.shape(0) != n)
      throw std::invalid_argument("features: expected [" + std::to_string(n) + ", 1 to 8]");
    return count;
  }
  void expect_images(int count, const Array& image, const Array& a, const Array& b) const {
    const size_t pixels = size_t(width_) * height_;
    expect(image, "image", pixels * count);
    expect(a, "transmittance", pixels);
    expect(b, "median_depth", pixels);
  }

  Array means2d_, conics_, opacities_, depths_;
  int width_, height_;
  Kernel kernel_{};
  obbgs::Splats splats_{};
  Bins bins_;
};

}  // namespace

NB_MODULE(_rasterizer, m) {
  m.def("kernels", [] {
    std::vector<std::string> names;
    for (const Kernel& k : available_kernels()) names.push_back(k.name);
    return names;
  });
  nb::class_<Rasterization>(m, "Rasterization")
      .def(nb::init<Array, Array, Array, Array, int, int, const std::string&>())
      .def("forward", &Rasterization::forward)
      .def("backward", &Rasterization::backward)
      .def_prop_ro("pairs", &Rasterization::pairs);
}
