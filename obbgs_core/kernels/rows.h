// Loops over one row of an image (or one block of parameters) that the compiler vectorises: losses and their gradients.
// Rows hold width * channels values, channels interleaved: a pixel's neighbour is `c` (channels) values away.
// Compiled once for each instruction set, in rows.cpp; others call what RowLoops points to. No loop adds up across lanes and
// a*b + c is never contracted, so every instruction set gives the same bits.
// Compile with -fno-math-errno -fno-trapping-math: square roots and conditions are scalar without them.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace obbgs {

constexpr int kReach = 5, kTaps = 2 * kReach + 1;  // SSIM window of Wang et al. 2004: 11 pixels, sigma 1.5
constexpr float kSsimC1 = 1e-4f, kSsimC2 = 9e-4f;  // (0.01)^2, (0.03)^2
constexpr float kKnee = 2;                         // of the Charbonnier penalty, sigma

struct SensorModel {
  float black, white, dn_per_electron, electrons_per_dn;
  float read_variance;   // DN^2, quantisation included
  float anscombe_floor;  // electrons^2
  float root_averaged;   // sqrt of the sensor pixels in one pixel: averaging shrinks the noise
};

struct Window { float taps[kTaps]; };

namespace rows {
namespace {

// exp(x) for -41 <= x <= 0, relative error 2e-7.
inline float exp_negative(float x) {
  const float t = x * 1.44269504f;
  const int32_t n = int32_t(t - 0.5f);  // truncation towards zero of a negative number rounds it
  const float f = (t - float(n)) * 0.693147181f;
  float p = f * 1.3888889e-3f + 8.3333333e-3f;
  p = p * f + 4.1666667e-2f;
  p = p * f + 1.6666667e-1f;
  p = p * f + 0.5f;
  p = p * f + 1.0f;
  p = p * f + 1.0f;
  const int32_t bits = (n + 127) << 23;
  float scale;
  std::memcpy(&scale, &bits, sizeof scale);
  return p * scale;
}

// erfc(u) exp(u^2) for 0 <= u <= 6.4: our least-squares fit to scipy.special.erfcx, relative error 3e-7 in float32.
inline float scaled_erfc(float u) {
  const float t = 1.0f / (1.0f + 0.4f * u);
  float p = 0.0833209604f * t - 0.442234159f;
  p = p * t + 0.792480409f;
  p = p * t - 0.511070251f;
  p = p * t + 0.514995456f;
  p = p * t + 0.088318862f;
  p = p * t + 0.251530409f;
  p = p * t + 0.22248739f;
  return p * t + 1.70917133e-4f;
}

// Noise-normalised residual of one row, its robust penalty (added to `penalty`), and d penalty / d radiance.
void likelihood_row(int n, const float* __restrict radiance, const float* __restrict dn, float gain,
                    const SensorModel s, float* __restrict residual, float* __restrict penalty,
                    float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    const float signal = gain * radiance[x], expected = s.black + signal;
    const float variance = (signal > 0 ? signal : 0) * s.dn_per_electron + s.read_variance;
    const float inverse_sigma = 1.0f / std::sqrt(variance);
    float z = expected * inverse_sigma;
    z = z < -9.0f ? -9.0f : z;
    z = z > 9.0f ? 9.0f : z;
    const float u = std::fabs(z) * 0.707106781f;
    const float bell = exp_negative(-u * u), tail = 0.5f * bell * scaled_erfc(u);
    const float below = z < 0 ? tail : 1.0f - tail;  // Phi(z): also d clipped mean / d expected
    float r = (expected * below - dn[x]) * inverse_sigma + 0.39894228f * bell;
    const bool censored = dn[x] >= s.white && r > 0;  // "at least this much": a brighter prediction is no error
    r = censored ? 0.0f : r * s.root_averaged;
    const float q = std::sqrt(1.0f + r * r * (1.0f / (kKnee * kKnee)));
    residual[x] = r;
    penalty[x] += r * r / (q + 1.0f);  // knee^2 (q - 1) without the cancellation
    slope[x] = censored ? 0.0f : r / q * below * inverse_sigma * gain * s.root_averaged;
  }
}

// Prediction minus reading on the variance-stabilised scale, prediction clamped at white, and its slope by radiance.
void stabilised_row(int n, const float* __restrict radiance, const float* __restrict dn, float gain,
                    const SensorModel s, float* __restrict difference, float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    const float signal = gain * radiance[x], most = s.white - s.black;
    const float predicted = (signal > most ? most : signal) * s.electrons_per_dn;
    const float read = (dn[x] - s.black) * s.electrons_per_dn;
    // 2(sqrt(p + floor) - sqrt(r + floor)) without the cancellation where the floor is large; roots of 0.001 at least
    const float least = 1e-3f - s.anscombe_floor;
    const float p = predicted < least ? least : predicted, r = read < least ? least : read;
    const float root = std::sqrt(p + s.anscombe_floor < 1e-3f ? 1e-3f : p + s.anscombe_floor);
    difference[x] = 2 * (p - r) / (root + std::sqrt(r + s.anscombe_floor < 1e-3f ? 1e-3f : r + s.anscombe_floor));
    slope[x] = (signal > most || predicted < least) ? 0.0f : s.electrons_per_dn * gain / root;
  }
}

void difference_row(int n, const float* __restrict a, const float* __restrict b, float* __restrict difference) {
  for (int x = 0; x < n; ++x) difference[x] = a[x] - b[x];
}

inline float sign(float x) { return x > 0 ? 1.0f : (x < 0 ? -1.0f : x); }  // keeps NaN

// Signs of the Sobel derivatives at the pixels of one row that have both neighbours; |dx| + |dy| goes to `sums`.
// up, mid, down: three rows of differences; n: width * channels; c: channels.
void sobel_row(int n, int c, const float* __restrict up, const float* __restrict mid, const float* __restrict down,
               float* __restrict sign_x, float* __restrict sign_y, float* __restrict sums) {
  for (int x = c; x < n - c; ++x) {
    const float dx = (up[x + c] + 2 * mid[x + c] + down[x + c]) - (up[x - c] + 2 * mid[x - c] + down[x - c]);
    const float dy = (down[x - c] + 2 * down[x] + down[x + c]) - (up[x - c] + 2 * up[x] + up[x + c]);
    sign_x[x] = sign(dx);
    sign_y[x] = sign(dy);
    sums[x] += std::fabs(dx) + std::fabs(dy);
  }
}

// gradient += scale * slope * (Sobel transposed of the signs); rows of signs have a zero margin of c on both sides.
void sobel_gradient_row(int n, int c, float scale, const float* __restrict x_up, const float* __restrict x_mid,
                        const float* __restrict x_down, const float* __restrict y_up, const float* __restrict y_down,
                        const float* __restrict slope, float* __restrict gradient) {
  for (int x = 0; x < n; ++x) {
    const float left = x_up[x - c] + 2 * x_mid[x - c] + x_down[x - c];
    const float right = x_up[x + c] + 2 * x_mid[x + c] + x_down[x + c];
    const float above = y_up[x - c] + 2 * y_up[x] + y_up[x + c];
    const float below = y_down[x - c] + 2 * y_down[x] + y_down[x + c];
    gradient[x] += scale * slope[x] * (left - right + above - below);
  }
}

// Gaussian sums down the columns of 11 rows: of a, b, a^2 + b^2 and a b.
void blur_down_products(int n, const Window w, const float* const* a, const float* const* b, float* __restrict out_a,
                        float* __restrict out_b, float* __restrict out_squares, float* __restrict out_product) {
  for (int x = 0; x < n; ++x) {
    float sum_a = 0, sum_b = 0, squares = 0, product = 0;
#pragma GCC unroll 11
    for (int k = 0; k < kTaps; ++k) {
      const float wa = w.taps[k] * a[k][x], wb = w.taps[k] * b[k][x];
      sum_a += wa;
      sum_b += wb;
      squares += wa * a[k][x] + wb * b[k][x];
      product += wa * b[k][x];
    }
    out_a[x] = sum_a;
    out_b[x] = sum_b;
    out_squares[x] = squares;
    out_product[x] = product;
  }
}

void blur_down(int n, const Window w, const float* const* rows, float* __restrict out) {
  for (int x = 0; x < n; ++x) {
    float sum = 0;
#pragma GCC unroll 11
    for (int k = 0; k < kTaps; ++k) sum += w.taps[k] * rows[k][x];
    out[x] = sum;
  }
}

// Gaussian sum along the row; the row has a zero margin of kReach * c on both sides.
inline float blur_along(const float* row, int c, const Window& w) {
  float sum = 0;
#pragma GCC unroll 11
  for (int k = 0; k < kTaps; ++k) sum += w.taps[k] * row[(k - kReach) * c];
  return sum;
}

// From columns already summed: 1 - SSIM (added to `sums`) and the slopes of SSIM by the blurred a, a^2 + b^2 and a b.
void ssim_row(int n, int c, const Window w, const float* __restrict column_a, const float* __restrict column_b,
              const float* __restrict column_squares, const float* __restrict column_product, float* __restrict sums,
              float* __restrict by_mean, float* __restrict by_squares, float* __restrict by_product) {
  for (int x = 0; x < n; ++x) {
    const float a = blur_along(column_a + x, c, w), b = blur_along(column_b + x, c, w);
    const float squares = blur_along(column_squares + x, c, w), product = blur_along(column_product + x, c, w);
    const float l1 = 2 * a * b + kSsimC1, l2 = a * a + b * b + kSsimC1;            // luminance l1 / l2
    const float s1 = 2 * (product - a * b) + kSsimC2, s2 = squares - a * a - b * b + kSsimC2;  // structure s1 / s2
    const float inverse = 1.0f / (l2 * s2), ssim = l1 * s1 * inverse;
    sums[x] += 1.0f - ssim;
    by_mean[x] = 2 * (b * (s1 - l1) * inverse + a * ssim * (l2 - s2) * inverse);
    by_squares[x] = -ssim * l2 * inverse;
    by_product[x] = 2 * l1 * inverse;
  }
}

// gradient += scale * d SSIM / d a, from the three slopes summed down the columns.
void ssim_gradient_row(int n, int c, const Window w, float scale, const float* __restrict by_mean,
                       const float* __restrict by_squares, const float* __restrict by_product,
                       const float* __restrict a, const float* __restrict b, float* __restrict gradient) {
  for (int x = 0; x < n; ++x)
    gradient[x] += scale * (blur_along(by_mean + x, c, w) + 2 * a[x] * blur_along(by_squares + x, c, w) +
                            b[x] * blur_along(by_product + x, c, w));
}

// difference = a - b; its size goes to `sums`; gradient = scale * sign(difference).
void absolute_row(int n, float scale, const float* __restrict a, const float* __restrict b,
                  float* __restrict difference, float* __restrict sums, float* __restrict gradient) {
  for (int x = 0; x < n; ++x) {
    const float d = a[x] - b[x];
    difference[x] = d;
    sums[x] += std::fabs(d);
    gradient[x] = scale * sign(d);
  }
}

// scaled = (row - zero) * gain
void scaled_row(int n, const float* __restrict row, float zero, float gain, float* __restrict scaled) {
  for (int x = 0; x < n; ++x) scaled[x] = (row[x] - zero) * gain;
}

void scale_row(int n, float scale, float* __restrict row) {
  for (int x = 0; x < n; ++x) row[x] *= scale;
}

// Squared differences of the reading and the prediction as the sensor would show it, for PSNR.
void squared_error_row(int n, const float* __restrict radiance, const float* __restrict dn, float gain,
                       const SensorModel s, float* __restrict sums) {
  for (int x = 0; x < n; ++x) {
    const float expected = s.black + gain * radiance[x];
    const float error = ((expected > s.white ? s.white : expected) - dn[x]) / s.white;
    sums[x] += error * error;
  }
}

void adam_block(size_t n, float* __restrict parameter, const float* __restrict gradient, float* __restrict first,
                float* __restrict second, float rate, float one_minus_b1, float b2, float one_minus_b2, float eps) {
  for (size_t i = 0; i < n; ++i) {
    const float g = gradient[i];
    first[i] += one_minus_b1 * (g - first[i]);
    second[i] = b2 * second[i] + one_minus_b2 * g * g;
    parameter[i] -= rate * first[i] / (std::sqrt(second[i]) + eps);
  }
}

}  // namespace
}  // namespace rows

// Every loop above that is called from elsewhere.
#define OBBGS_ROW_LOOPS(each) \
  each(likelihood_row) each(stabilised_row) each(difference_row) each(sobel_row) each(sobel_gradient_row) \
  each(blur_down_products) each(blur_down) each(ssim_row) each(ssim_gradient_row) each(absolute_row) \
  each(scaled_row) each(scale_row) each(squared_error_row) each(adam_block)

struct RowLoops {  // the loops as one instruction set has them; rows.cpp fills it
#define OBBGS_MEMBER(name) decltype(&rows::name) name;
  OBBGS_ROW_LOOPS(OBBGS_MEMBER)
#undef OBBGS_MEMBER
};
namespace portable { extern const RowLoops row_loops; }
namespace avx2 { extern const RowLoops row_loops; }
namespace avx512 { extern const RowLoops row_loops; }

void use_row_loops(const RowLoops& loops);  // from now on; training.cpp

}  // namespace obbgs
