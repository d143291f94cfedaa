// Images [count, height, width, channels] float32 from Python, cut into bands of rows of a fixed size whose sums are
// added in order, so that the result does not depend on the number of threads. The loops over each row are in rows.h,
// once for each instruction set.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <numeric>
#include <stdexcept>
#include <string>
#include <vector>

#include "machine/threads.h"
#include "rows/rows.h"

namespace nb = nanobind;
using Array = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

namespace obbgs {

extern const RowLoops* loops;  // of the instruction set in use

constexpr int kBandRows = 40;

struct Shape {
  int count, height, width, channels;
  int row() const { return width * channels; }
  size_t image() const { return size_t(height) * row(); }
  double values() const { return double(count) * height * row(); }
  double edges() const { return double(count) * (height - 2) * (width - 2) * channels; }
};

struct Band {
  int image, begin, end;
};  // rows begin .. end - 1

// Returns the sum of work(band) over all bands of all images, added in their order.
template <typename Sum = double, typename Work>
Sum sum_over_bands(const Shape& shape, int threads, Work work, int band_rows = kBandRows) {
  const int per_image = (shape.height + band_rows - 1) / band_rows;
  std::vector<Sum> parts(size_t(shape.count) * per_image);
  parallel_for(int(parts.size()), threads, [&](int i) {
    const int begin = i % per_image * band_rows;
    parts[i] = work(Band{i / per_image, begin, std::min(begin + band_rows, shape.height)});
  });
  return std::accumulate(parts.begin(), parts.end(), Sum{});
}

inline double total(const std::vector<float>& sums) { return std::accumulate(sums.begin(), sums.end(), 0.0); }

// A few rows of a padded image, kept by row number.
class Rows {
 public:
  Rows(int first, int last, int width, int margin = 0)
      : first_(first), stride_(width + 2 * margin), margin_(margin), values_(size_t(last - first) * stride_, 0.0f) {}
  float* operator[](int row) { return values_.data() + size_t(row - first_) * stride_ + margin_; }

 private:
  int first_, stride_, margin_;
  std::vector<float> values_;
};

// Adds scale * d (|Sx| + |Sy|) / d radiance to the band's rows of `gradient` (when there is one) and returns the sum of
// |Sx| + |Sy| over the band. fill(row, difference, slope) makes a row of differences and their slopes by radiance. Only
// `n` values of each row are looked at, and `gradient` begins with the first of them.
template <typename Fill>
double edge_band(const Shape& shape, const Band& band, int n, float scale, float* gradient, Fill fill) {
  const int c = shape.channels;
  const int first = std::max(band.begin - 2, 0), last = std::min(band.end + 2, shape.height);
  Rows difference(first, last, n), slope(first, last, n);
  for (int y = first; y < last; ++y) fill(y, difference[y], slope[y]);
  Rows sign_x(band.begin - 1, band.end + 1, n, c), sign_y(band.begin - 1, band.end + 1, n, c);
  std::vector<float> inside(n, 0.0f), halo(n);
  for (int y = std::max(band.begin - 1, 1); y < std::min(band.end + 1, shape.height - 1); ++y) {
    float* sums = y >= band.begin && y < band.end
                      ? inside.data()
                      : halo.data();  // the other rows are counted by the neighbouring bands
    loops->sobel_row(n, c, difference[y - 1], difference[y], difference[y + 1], sign_x[y], sign_y[y], sums);
  }
  for (int y = band.begin; gradient && y < band.end; ++y)
    loops->sobel_gradient_row(n, c, scale, sign_x[y - 1], sign_x[y], sign_x[y + 1], sign_y[y - 1], sign_y[y + 1],
                              slope[y], gradient + size_t(y) * shape.row());
  return total(inside);
}

inline Shape shape_of(const Array& images, const char* name) {
  if (images.ndim() != 4)
    throw std::invalid_argument(std::string(name) + ": expected [count, height, width, channels]");
  return {int(images.shape(0)), int(images.shape(1)), int(images.shape(2)), int(images.shape(3))};
}

inline void expect(const Array& array, const char* name, size_t count) {
  if (array.size() != count)
    throw std::invalid_argument(std::string(name) + ": expected " + std::to_string(count) + " numbers, got " +
                                std::to_string(array.size()));
}

}  // namespace obbgs
