// Loops over one row of an image (or one block of parameters) that the compiler vectorises: losses, gradients, Adam.
// Rows hold width * channels values, channels interleaved: a pixel's neighbour is `c` (channels) values away.
// Compiled once for each instruction set, in rows.cpp; training.cpp calls them through RowLoops. No loop adds up across
// lanes and a*b + c is never contracted, so every instruction set gives the same bits. Compile with -fno-math-errno
// -fno-trapping-math: square roots and conditions are scalar without them.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace obbgs {

constexpr int kReach = 5, kTaps = 2 * kReach + 1;  // SSIM window of Wang et al. 2004: 11 pixels, sigma 1.5
constexpr float kSsimC1 = 1e-4f, kSsimC2 = 9e-4f;  // (0.01)^2, (0.03)^2
constexpr float kKnee = 2;                         // sigma, where the Charbonnier penalty turns from square to linear
constexpr float kTail = 3;                         // sigma, where the Cauchy penalty turns from square to logarithm
constexpr float kHalfDn = 0.5f;                    // rounding: a reading of 0 means a signal below this

struct SensorModel {
  float black, white, dn_per_electron, electrons_per_dn;
  float read_variance;   // DN^2, quantisation included
  float anscombe_floor;  // electrons^2
  float root_averaged;   // sqrt of the sensor pixels in one pixel: averaging shrinks the noise
  float misfit;          // variance of the model's own error over the squared light; negative: not known
  float misfit_floor;    // DN^2, what it is beside that everywhere in a picture; both times the sensor pixels in one
};

struct Window {
  float taps[kTaps];
};

namespace rows {
namespace {

// exp(x) for -41 <= x <= 0, relative error 2e-7.
inline float exp_negative(float x) {
  const float t = x * 1.44269504f;
  const float bounded = t >= -60.0f ? t : -60.0f;  // NaN has no integer; below, f and so the result are still NaN
  const int32_t n = int32_t(bounded - 0.5f);       // truncation towards zero of a negative number rounds it
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

// log(x) for 0 < x < 1e30, of x and x - 1 (which may be known more exactly), relative error 2e-7: the series of atanh
// of a mantissa in 0.7 .. 1.4.
inline float log_positive(float x, float x_minus_1) {
  int32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  const int32_t exponent = (bits - 0x3f3504f3) >> 23;  // of x over the root of one half
  bits -= exponent * (1 << 23);
  float m;
  std::memcpy(&m, &bits, sizeof m);
  const float s = (exponent == 0 ? x_minus_1 : m - 1.0f) / (m + 1.0f), w = s * s;
  float p = w * 0.111111111f + 0.142857143f;
  p = p * w + 0.2f;
  p = p * w + 0.333333333f;
  return 2.0f * s * (p * w + 1.0f) + float(exponent) * 0.693147181f;
}

// The normal distribution at z: its density, and Phi(-|z|) with 0 beyond 9.
struct Normal {
  float density, tail;
};
inline Normal normal(float z) {
  float u = std::fabs(z) * 0.707106781f;
  u = u > 6.36396103f ? 6.36396103f : u;
  const float bell = exp_negative(-u * u);
  return {0.39894228f * bell, u < 6.36396103f ? 0.5f * bell * scaled_erfc(u) : 0.0f};
}

// The unclipped expected reading of a signal, DN, and one over the deviation of its noise.
inline float expected_dn(float signal, const SensorModel& s, float& inverse_sigma) {
  inverse_sigma = 1.0f / std::sqrt((signal > 0 ? signal : 0) * s.dn_per_electron + s.read_variance);
  return s.black + signal;
}

// Robust penalty of a squared residual; its slope is residual / q. Where the model's own error is not known:
// Charbonnier, knee^2 (q - 1) without the cancellation, q = sqrt(1 + (r / knee)^2). Otherwise Cauchy, tail^2 / 2
// log(q), q = 1 + (r / tail)^2, of residuals over both errors: `share` is the noise's share of their deviation.
inline float robust(float& squared, float signal, float inverse_sigma, const SensorModel& s, float& share, float& q) {
  const float seen = signal < 0 ? 0.0f : (signal > s.white - s.black ? s.white - s.black : signal);
  const bool known = s.misfit >= 0;
  const float error = (s.misfit * seen * seen + s.misfit_floor) * inverse_sigma * inverse_sigma;
  share = known ? 1.0f / std::sqrt(1.0f + error) : 1.0f;
  squared *= share * share;
  const float w = squared * (1.0f / (kTail * kTail)), bounded = w < 1e29f ? w : 1e29f + 0 * w;
  const float smooth = std::sqrt(1.0f + squared * (1.0f / (kKnee * kKnee)));
  q = known ? 1.0f + w : smooth;
  return known ? 0.5f * kTail * kTail * log_positive(1.0f + bounded, bounded) : squared / (smooth + 1.0f);
}

// Deviance residual of one row of sensor pixels, its robust penalty (added to `penalty`), and d penalty / d radiance.
// A reading at a clip has the probability Phi(b) of lying beyond it, b: the prediction's distance from it in sigma.
void likelihood_row(int n, const float* __restrict radiance, const float* __restrict dn, float gain,
                    const SensorModel s, float* __restrict residual, float* __restrict penalty,
                    float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    float inverse_sigma;
    const float expected = expected_dn(gain * radiance[x], s, inverse_sigma);
    const bool saturated = dn[x] >= s.white, clipped = saturated || dn[x] <= 0;
    const float b = (saturated ? expected - (s.white - kHalfDn) : kHalfDn - expected) * inverse_sigma;
    // -2 log Phi(b) and phi(b) / Phi(b), by the tail over its bell where Phi is small; past 9 sigma the tail's
    // asymptote
    float u = std::fabs(b) * 0.707106781f;
    u = u > 6.36396103f ? 6.36396103f : u;
    const float bell = exp_negative(-u * u), i = 1.0f / (b * b + 1e-6f);
    const float asymptote = 0.39894228f * std::sqrt(i) * (1.0f - i * (1.0f - 3.0f * i * (1.0f - 5.0f * i)));
    const float scaled = b < -9.0f ? asymptote : 0.5f * scaled_erfc(u);
    const float phi = b < 0 ? scaled : 1.0f - bell * scaled;  // over the bell below zero
    const float phi_minus_1 = b < 0 ? scaled - 1.0f : -bell * scaled;
    const float deviance = (b < 0 ? b * b : 0.0f) - 2.0f * log_positive(phi, phi_minus_1);
    const float hazard = 0.39894228f * (b < 0 ? 1.0f : bell) / phi;
    const float z = (expected - dn[x]) * inverse_sigma;
    float squared = clipped ? (deviance > 0 ? deviance : 0.0f) + 0 * z : z * z;  // NaN stays NaN
    float q, share;
    penalty[x] += robust(squared, expected - s.black, inverse_sigma, s, share, q);
    const float root = std::sqrt(squared);
    residual[x] = clipped ? (saturated ? -root : root) : z * share;
    slope[x] = (clipped ? (saturated ? -hazard : hazard) : z) / q * inverse_sigma * gain * share * share;
  }
}

// The same, bit for bit, where no reading of the row lies at a clip.
void unclipped_likelihood_row(int n, const float* __restrict radiance, const float* __restrict dn, float gain,
                              const SensorModel s, float* __restrict residual, float* __restrict penalty,
                              float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    float inverse_sigma, q, share;
    const float expected = expected_dn(gain * radiance[x], s, inverse_sigma);
    const float z = (expected - dn[x]) * inverse_sigma;
    float squared = z * z;
    penalty[x] += robust(squared, expected - s.black, inverse_sigma, s, share, q);
    residual[x] = z * share;
    slope[x] = z / q * inverse_sigma * gain * share * share;
  }
}

// The same for means of several sensor pixels: expectation of readings clipped at zero, normal noise, saturated means
// fitted by any brighter prediction.
void averaged_likelihood_row(int n, const float* __restrict radiance, const float* __restrict dn, float gain,
                             const SensorModel s, float* __restrict residual, float* __restrict penalty,
                             float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    float inverse_sigma;
    const float expected = expected_dn(gain * radiance[x], s, inverse_sigma);
    const float z = expected * inverse_sigma;
    const Normal at_zero = normal(z);
    const float below = z < 0 ? at_zero.tail : 1.0f - at_zero.tail;  // also d clipped mean / d expected
    float r = (expected * below - dn[x]) * inverse_sigma + at_zero.density;
    const bool censored = dn[x] >= s.white && r > 0;
    r = censored ? 0.0f : r * s.root_averaged;
    float q, share, squared = r * r;
    penalty[x] += robust(squared, expected - s.black, inverse_sigma, s, share, q);
    residual[x] = r * share;
    slope[x] = censored ? 0.0f : r / q * below * inverse_sigma * gain * s.root_averaged * share * share;
  }
}

// Squared differences of readings and their expectation, and the variance of the readings, both over that of the
// noise, times `seen` (0 or 1). A saturated mean of several pixels is left out.
void chi2_row(int n, const float* __restrict radiance, const float* __restrict dn, const float* __restrict seen,
              float gain, const SensorModel s, float* __restrict squares, float* __restrict variances) {
  for (int x = 0; x < n; ++x) {
    float inverse_sigma;
    const float expected = expected_dn(gain * radiance[x], s, inverse_sigma);
    const float low = -expected * inverse_sigma, high = (s.white - expected) * inverse_sigma;
    const Normal at_low = normal(low), at_high = normal(high);
    const float below = low < 0 ? at_low.tail : 1.0f - at_low.tail;
    const float above = high > 0 ? at_high.tail : 1.0f - at_high.tail;
    const float lifted = low * below + at_low.density, lowered = at_high.density - high * above;
    const float shift = lifted - lowered;
    const float inside = 1.0f - below - above + low * at_low.density - high * at_high.density;
    float spread = inside + low * low * below + high * high * above - shift * shift;
    spread = (below >= 1.0f || above >= 1.0f || spread < 0) ? 0.0f : spread;  // always clipped: no variance
    float r = (expected - dn[x]) * inverse_sigma + shift;
    r = above >= 1.0f ? (s.white - dn[x]) * inverse_sigma : (below >= 1.0f ? -dn[x] * inverse_sigma : r);
    const float counts = s.root_averaged == 1.0f || dn[x] < s.white ? seen[x] : 0.0f;
    squares[x] += counts * r * r;
    variances[x] += counts * spread;
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
    const float l1 = 2 * a * b + kSsimC1, l2 = a * a + b * b + kSsimC1;                        // luminance l1 / l2
    const float s1 = 2 * (product - a * b) + kSsimC2, s2 = squares - a * a - b * b + kSsimC2;  // structure s1 / s2
    const float inverse = 1.0f / (l2 * s2), ssim = l1 * s1 * inverse;
    sums[x] += 1.0f - ssim;
    by_mean[x] = 2 * (b * (s1 - l1) * inverse + a * ssim * (l2 - s2) * inverse);
    by_squares[x] = -ssim * l2 * inverse;
    by_product[x] = 2 * l1 * inverse;
  }
}

// gradient += scale * slope * d SSIM / d a, from the three slopes of SSIM summed down the columns.
void ssim_gradient_row(int n, int c, const Window w, float scale, const float* __restrict slope,
                       const float* __restrict by_mean, const float* __restrict by_squares,
                       const float* __restrict by_product, const float* __restrict a, const float* __restrict b,
                       float* __restrict gradient) {
  for (int x = 0; x < n; ++x)
    gradient[x] += scale * slope[x] *
                   (blur_along(by_mean + x, c, w) + 2 * a[x] * blur_along(by_squares + x, c, w) +
                    b[x] * blur_along(by_product + x, c, w));
}

// difference = a - b; its size goes to `sums`; gradient = sign(difference) * slope.
void absolute_row(int n, const float* __restrict slope, const float* __restrict a, const float* __restrict b,
                  float* __restrict difference, float* __restrict sums, float* __restrict gradient) {
  for (int x = 0; x < n; ++x) {
    const float d = a[x] - b[x];
    difference[x] = d;
    sums[x] += std::fabs(d);
    gradient[x] = sign(d) * slope[x];
  }
}

// A prediction row * gain clamped at `most`, and `slope`: its derivative by the row. What is not finite becomes NaN.
void clamped_row(int n, const float* __restrict row, float gain, float most, float* __restrict clamped,
                 float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    const float value = row[x] * gain;
    clamped[x] = value > most ? most + 0 * value : value;
    slope[x] = value > most ? 0.0f : gain;
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
                float* __restrict second, const float* __restrict rates, float one_minus_b1, float b2,
                float one_minus_b2, float eps) {
  for (size_t i = 0; i < n; ++i) {
    const float g = gradient[i];
    first[i] += one_minus_b1 * (g - first[i]);
    second[i] = b2 * second[i] + one_minus_b2 * g * g;
    parameter[i] -= rates[i] * first[i] / (std::sqrt(second[i]) + eps);
  }
}

}  // namespace
}  // namespace rows

// The loops above that are called from training.cpp.
#define OBBGS_ROW_LOOPS(each)                                                                                          \
  each(likelihood_row) each(unclipped_likelihood_row) each(averaged_likelihood_row) each(chi2_row)                     \
      each(stabilised_row) each(difference_row) each(sobel_row) each(sobel_gradient_row) each(blur_down_products)      \
          each(blur_down) each(ssim_row) each(ssim_gradient_row) each(absolute_row) each(clamped_row) each(scaled_row) \
              each(scale_row) each(squared_error_row) each(adam_block)

struct RowLoops {  // pointers to the loops of one instruction set; rows.cpp fills it
#define OBBGS_MEMBER(name) decltype(&rows::name) name;
  OBBGS_ROW_LOOPS(OBBGS_MEMBER)
#undef OBBGS_MEMBER
};
namespace portable {
extern const RowLoops row_loops;
}
namespace avx2 {
extern const RowLoops row_loops;
}
namespace avx512 {
extern const RowLoops row_loops;
}

void use_row_loops(const RowLoops& loops);  // from now on; training.cpp

}  // namespace obbgs
