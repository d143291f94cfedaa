// Vectors of eight or sixteen floats: one block of pixels, or as many Gaussians.
// Included once for each instruction set; KERNEL names the namespace. Built without contraction of a*b+c: `fma` rounds
// once everywhere. Instruction sets with blocks of one shape take the same decisions at the cutoffs; where blocks have
// another shape, a pixel's place in its block rounds otherwise in the last bit.
#pragma once
#include <cstdint>
#include <cstring>
#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace obbgs {
namespace KERNEL {

#if defined(__AVX512F__)
constexpr int kLanes = 16, kWidth = 16;  // of a vector, and of one register
#elif defined(__AVX2__)
constexpr int kLanes = 8, kWidth = 8;
#else
constexpr int kLanes = 16, kWidth = 4;
#endif
constexpr int kParts = kLanes / kWidth;

#define OBBGS_INLINE inline __attribute__((always_inline))  // a call would pass its vectors through memory

typedef float FloatPart __attribute__((vector_size(4 * kWidth)));
typedef int32_t IntPart __attribute__((vector_size(4 * kWidth)));

struct vf {
  FloatPart part[kParts];
  vf() = default;
  OBBGS_INLINE vf(float x) {
    for (FloatPart& p : part) p = x - FloatPart{};
  }
  float& operator[](int lane) { return reinterpret_cast<float*>(part)[lane]; }
  float operator[](int lane) const { return reinterpret_cast<const float*>(part)[lane]; }
};

struct vi {
  IntPart part[kParts];
  vi() = default;
  OBBGS_INLINE vi(int32_t x) {
    for (IntPart& p : part) p = x - IntPart{};
  }
  int32_t& operator[](int lane) { return reinterpret_cast<int32_t*>(part)[lane]; }
  int32_t operator[](int lane) const { return reinterpret_cast<const int32_t*>(part)[lane]; }
};

#define OBBGS_LANEWISE(type, op)                                         \
  OBBGS_INLINE type operator op(type a, type b) {                        \
    for (int p = 0; p < kParts; ++p) a.part[p] = a.part[p] op b.part[p]; \
    return a;                                                            \
  }
OBBGS_LANEWISE(vf, +)
OBBGS_LANEWISE(vf, -)
OBBGS_LANEWISE(vf, *)
OBBGS_LANEWISE(vf, /)
OBBGS_LANEWISE(vi, +)
OBBGS_LANEWISE(vi, -)
OBBGS_LANEWISE(vi, &)
OBBGS_LANEWISE(vi, <<)
OBBGS_LANEWISE(vi, >>)
#undef OBBGS_LANEWISE
OBBGS_INLINE vf operator-(vf a) {
  for (FloatPart& p : a.part) p = -p;
  return a;
}

OBBGS_INLINE vf load(const float* x) {
  vf v;
  std::memcpy(&v, x, sizeof v);
  return v;
}
OBBGS_INLINE void store(float* x, vf v) { std::memcpy(x, &v, sizeof v); }
OBBGS_INLINE vi bits_of(vf x) {
  vi v;
  std::memcpy(&v, &x, sizeof v);
  return v;
}
OBBGS_INLINE vf float_of(vi x) {
  vf v;
  std::memcpy(&v, &x, sizeof v);
  return v;
}

OBBGS_INLINE vi operator~(vi a) {
  for (IntPart& p : a.part) p = ~p;
  return a;
}
OBBGS_INLINE vi truncate(vf x) {
  vi v;
  for (int p = 0; p < kParts; ++p) v.part[p] = __builtin_convertvector(x.part[p], IntPart);
  return v;
}
OBBGS_INLINE vf to_float(vi x) {
  vf v;
  for (int p = 0; p < kParts; ++p) v.part[p] = __builtin_convertvector(x.part[p], FloatPart);
  return v;
}
OBBGS_INLINE void store_bytes(void* to, vi x) {  // the low byte of each lane
#if defined(__AVX512F__)
  const __m128i bytes = _mm512_cvtepi32_epi8(reinterpret_cast<__m512i>(x.part[0]));
#else
  uint8_t bytes[kLanes];
  for (int l = 0; l < kLanes; ++l) bytes[l] = uint8_t(x[l]);
#endif
  std::memcpy(to, &bytes, kLanes);
}

// a*b + c rounded once, also where the processor cannot (there by way of double).
OBBGS_INLINE vf fma(vf a, vf b, vf c) {
  for (int p = 0; p < kParts; ++p) {
#if defined(__AVX512F__)
    c.part[p] = _mm512_fmadd_ps(a.part[p], b.part[p], c.part[p]);
#elif defined(__FMA__)
    c.part[p] = _mm256_fmadd_ps(a.part[p], b.part[p], c.part[p]);
#elif defined(__aarch64__)
    c.part[p] = vfmaq_f32(c.part[p], a.part[p], b.part[p]);
#else
    typedef double DoublePart __attribute__((vector_size(8 * kWidth)));
    const DoublePart product =
        __builtin_convertvector(a.part[p], DoublePart) * __builtin_convertvector(b.part[p], DoublePart);
    c.part[p] = __builtin_convertvector(product + __builtin_convertvector(c.part[p], DoublePart), FloatPart);
#endif
  }
  return c;
}
OBBGS_INLINE vf minus_fma(vf a, vf b, vf c) { return fma(-a, b, c); }  // c - a*b

// a*b + c where the last bit decides nothing: fused where that is fast.
OBBGS_INLINE vf multiply_add(vf a, vf b, vf c) {
#if defined(__FMA__) || defined(__aarch64__)
  return fma(a, b, c);
#else
  return a * b + c;
#endif
}

#if defined(__AVX512F__)
struct mask {
  __mmask16 bits;
};
OBBGS_INLINE mask operator<(vf a, vf b) { return {_mm512_cmp_ps_mask(a.part[0], b.part[0], _CMP_LT_OQ)}; }
OBBGS_INLINE mask operator<=(vf a, vf b) { return {_mm512_cmp_ps_mask(a.part[0], b.part[0], _CMP_LE_OQ)}; }
OBBGS_INLINE mask operator&(mask a, mask b) { return {__mmask16(a.bits & b.bits)}; }
OBBGS_INLINE mask and_not(mask a, mask b) { return {__mmask16(a.bits & ~b.bits)}; }
OBBGS_INLINE bool any(mask m) { return m.bits; }
OBBGS_INLINE bool all_negative(vf a) { return _mm512_cmp_ps_mask(a.part[0], _mm512_setzero_ps(), _CMP_NLT_UQ) == 0; }
OBBGS_INLINE vf select(mask m, vf a, vf b) {
  a.part[0] = _mm512_mask_blend_ps(m.bits, b.part[0], a.part[0]);
  return a;
}
#else
struct mask {
  IntPart part[kParts];
};
OBBGS_INLINE mask operator<(vf a, vf b) {
  mask m;
  for (int p = 0; p < kParts; ++p) m.part[p] = a.part[p] < b.part[p];
  return m;
}
OBBGS_INLINE mask operator<=(vf a, vf b) {
  mask m;
  for (int p = 0; p < kParts; ++p) m.part[p] = a.part[p] <= b.part[p];
  return m;
}
OBBGS_INLINE mask operator&(mask a, mask b) {
  for (int p = 0; p < kParts; ++p) a.part[p] &= b.part[p];
  return a;
}
OBBGS_INLINE mask and_not(mask a, mask b) {
  for (int p = 0; p < kParts; ++p) a.part[p] &= ~b.part[p];
  return a;
}
OBBGS_INLINE vf select(mask m, vf a, vf b) {
#if defined(__AVX2__)
  a.part[0] = _mm256_blendv_ps(b.part[0], a.part[0], reinterpret_cast<__m256>(m.part[0]));
#else
  for (int p = 0; p < kParts; ++p) a.part[p] = m.part[p] ? a.part[p] : b.part[p];
#endif
  return a;
}
OBBGS_INLINE bool any(mask m) {
  IntPart all = m.part[0];
  for (int p = 1; p < kParts; ++p) all |= m.part[p];
  int32_t merged = 0;
#if defined(__AVX2__)
  merged = _mm256_movemask_ps(reinterpret_cast<__m256>(all));
#elif defined(__SSE2__)
  merged = _mm_movemask_ps(reinterpret_cast<__m128>(all));
#else
  for (int l = 0; l < kWidth; ++l) merged |= all[l];
#endif
  return merged;
}
OBBGS_INLINE bool all_negative(vf a) {
#if defined(__AVX2__)
  return _mm256_movemask_ps(a.part[0]) == 0xFF;
#else
  return !any(vf(0.0f) <= a);
#endif
}
#endif

OBBGS_INLINE vf zero_unless(mask m, vf a) { return select(m, a, vf(0.0f)); }
#if defined(__AVX512F__)
OBBGS_INLINE vf smaller(vf a, vf b) {  // a where either is not a number
  a.part[0] = _mm512_min_ps(b.part[0], a.part[0]);
  return a;
}
OBBGS_INLINE vf larger(vf a, vf b) {
  a.part[0] = _mm512_max_ps(b.part[0], a.part[0]);
  return a;
}
#elif defined(__AVX2__)
OBBGS_INLINE vf smaller(vf a, vf b) {
  a.part[0] = _mm256_min_ps(b.part[0], a.part[0]);
  return a;
}
OBBGS_INLINE vf larger(vf a, vf b) {
  a.part[0] = _mm256_max_ps(b.part[0], a.part[0]);
  return a;
}
#else
OBBGS_INLINE vf smaller(vf a, vf b) { return select(b < a, b, a); }  // a where either is not a number
OBBGS_INLINE vf larger(vf a, vf b) { return select(a < b, b, a); }
#endif
OBBGS_INLINE vf absolute(vf a) { return float_of(bits_of(a) & vi(0x7FFFFFFF)); }

OBBGS_INLINE vf sqrt(vf x) {
  float lane[kLanes];
  store(lane, x);
  for (float& value : lane) value = __builtin_sqrtf(value);
  return load(lane);
}

// 1/x, relative error 3e-7: an estimate and one Newton step cost less than a division.
OBBGS_INLINE vf reciprocal(vf x) {
  vf r;
  for (int p = 0; p < kParts; ++p) {
#if defined(__AVX512F__)
    r.part[p] = _mm512_rcp14_ps(x.part[p]);
#elif defined(__AVX2__)
    r.part[p] = _mm256_rcp_ps(x.part[p]);
#elif defined(__SSE2__)
    r.part[p] = _mm_rcp_ps(x.part[p]);
#else
    r.part[p] = 1.0f / x.part[p];
    continue;
#endif
    r.part[p] = r.part[p] * (2.0f - x.part[p] * r.part[p]);
  }
  return r;
}

OBBGS_INLINE float sum(vf v) {
  float lane[kLanes];
  store(lane, v);
  for (int half = kLanes / 2; half; half /= 2)
    for (int l = 0; l < half; ++l) lane[l] += lane[l + half];
  return lane[0];
}

// record[slot(i)] = the sum of all lanes of sums[i], for up to sixteen vectors: where the order falls out of adding up
// many at once, it is as it falls.
#if defined(__AVX512F__)
constexpr int slot(int sum) { return 4 * (sum % 4) + sum / 4; }
template <int N>
OBBGS_INLINE void add_lanes(const vf (&sums)[N], float* record) {  // adds while transposing: four rounds
  __m512 v[16], half[8], quarter[4];
  for (int i = 0; i < 16; ++i) v[i] = i < N ? sums[i].part[0] : _mm512_setzero_ps();
  for (int i = 0; i < 8; ++i)
    half[i] = _mm512_add_ps(_mm512_shuffle_f32x4(v[2 * i], v[2 * i + 1], 0x44),
                            _mm512_shuffle_f32x4(v[2 * i], v[2 * i + 1], 0xEE));
  for (int i = 0; i < 4; ++i)
    quarter[i] = _mm512_add_ps(_mm512_shuffle_f32x4(half[2 * i], half[2 * i + 1], 0x88),
                               _mm512_shuffle_f32x4(half[2 * i], half[2 * i + 1], 0xDD));
  const auto add = [](__m512 a, __m512 b) { return _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b)); };
  const __m512d low = _mm512_castps_pd(add(quarter[0], quarter[1])),
                high = _mm512_castps_pd(add(quarter[2], quarter[3]));
  _mm512_store_ps(record, _mm512_add_ps(_mm512_castpd_ps(_mm512_unpacklo_pd(low, high)),
                                        _mm512_castpd_ps(_mm512_unpackhi_pd(low, high))));
}
#else
constexpr int slot(int sum) { return sum; }
template <int N>
OBBGS_INLINE void add_lanes(const vf (&sums)[N], float* record) {
#if defined(__AVX2__)
  for (int first = 0; first < N; first += 8) {
    __m256 v[8];
    for (int i = 0; i < 8; ++i) v[i] = first + i < N ? sums[first + i].part[0] : _mm256_setzero_ps();
    const __m256 low = _mm256_hadd_ps(_mm256_hadd_ps(v[0], v[1]), _mm256_hadd_ps(v[2], v[3])),
                 high = _mm256_hadd_ps(_mm256_hadd_ps(v[4], v[5]), _mm256_hadd_ps(v[6], v[7]));
    _mm256_store_ps(record + first,
                    _mm256_add_ps(_mm256_permute2f128_ps(low, high, 0x20), _mm256_permute2f128_ps(low, high, 0x31)));
  }
#else
  for (int i = 0; i < N; ++i) record[i] = sum(sums[i]);
#endif
}
#endif

// 2^x, relative error 2e-7. Below -126 the result is negative or not a number, which no cutoff lets pass; below -380 it
// is wrong.
OBBGS_INLINE vf exp2_unbounded(vf x) {
  const vf shifted = x + 12582912.0f;  // 1.5 * 2^23: the low bits now hold x rounded to an integer
  const vf f = x - (shifted - 12582912.0f);
  vf p = fma(f, 1.326472663e-3f, 9.671512959e-3f);  // minimax on -0.5..0.5
  p = fma(p, f, 5.550733748e-2f);
  p = fma(p, f, 2.402224208e-1f);
  p = fma(p, f, 6.931469776e-1f);
  p = fma(p, f, 1.0f);
  return float_of(bits_of(p) + (bits_of(shifted) << vi(23)));
}

// e^x, relative error 3e-7; 0 below -87, infinite above 88, not a number of what is none.
OBBGS_INLINE vf exp(vf x) {
  const vf bounded = smaller(larger(x, -87.0f), 88.0f);
  const vf power = bounded * 1.44269504f;
  const vf lost = fma(bounded, 1.44269504f, -power) + bounded * 1.92596303e-8f;
  const vf result = exp2_unbounded(power) * fma(lost, 0.693147181f, 1.0f);
  return select(x <= vf(88.0f), zero_unless(vf(-87.0f) <= x, result), x + __builtin_inff());
}

// atanh(z) for |z| <= 1/3, relative error 1e-7.
OBBGS_INLINE vf atanh_third(vf z) {
  const vf s = z * z;
  vf p = fma(s, 1.214493526e-1f, 1.071533291e-1f);
  p = fma(p, s, 1.430830142e-1f);
  p = fma(p, s, 1.999944408e-1f);
  p = fma(p, s, 3.333333775e-1f);
  return fma(p * s, z, z);
}

// log2(x) of a positive normal number.
OBBGS_INLINE vf log2(vf x) {
  const vi exponent = (bits_of(x) - vi(0x3F3504F3)) >> vi(23);  // x = m 2^exponent with m in sqrt(1/2)..sqrt(2)
  const vf m = float_of(bits_of(x) - (exponent << vi(23)));
  return fma(atanh_third((m - 1.0f) / (m + 1.0f)), 2.88539008f, to_float(exponent));
}

}  // namespace KERNEL
}  // namespace obbgs
