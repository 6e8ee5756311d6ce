// Number types and vectors of them. Included by resample.h.

constexpr int TILE = 64;
constexpr float OUTSIDE = -2.0f;                // an index whose taps are all outside
constexpr float LARGEST = 3.402823466e38f, SMALLEST = 0x1p-126f;
constexpr float SMALLEST_DEPTH = 0x1p-60f;
constexpr float LARGEST_COORDINATE = 0x1p100f;

// Half-precision numbers become float32 where they are loaded, and are rounded where they are stored.

struct Bfloat16 { uint16_t bits; };
struct Float16 { uint16_t bits; };

inline float from_bits(uint32_t bits) { float value; std::memcpy(&value, &bits, 4); return value; }
inline uint32_t to_bits(float value) { uint32_t bits; std::memcpy(&bits, &value, 4); return bits; }

inline float clamped(float value, float largest) {
    return value > largest ? largest : value < -largest ? -largest : value;
}

// Above this an output saturates and has no gradient, as in `lsmgeo._dtypes.saturation_limit`.
inline float saturation_limit(int64_t type) {
    return type == FLOAT32 ? LARGEST : type == BFLOAT16 ? 0x1.fe7f8p127f : 0x1.ffcffep15f;
}

// Vectors of W floats. The compiler splits them into registers of the instruction set; arithmetic is lane by lane.

template <int W> struct Vector {
    typedef float Floats __attribute__((vector_size(4 * W)));
    typedef int32_t Masks __attribute__((vector_size(4 * W)));
    typedef uint32_t Bits __attribute__((vector_size(4 * W)));
    typedef uint16_t Halves __attribute__((vector_size(2 * W)));
};
template <int W> using Floats = typename Vector<W>::Floats;
template <int W> using Masks = typename Vector<W>::Masks;
template <int W> using Bits = typename Vector<W>::Bits;

template <int W> INLINE Floats<W> load(const float *place) {
    Floats<W> values;
    std::memcpy(&values, place, sizeof values);
    return values;
}
template <int W> INLINE Bits<W> load_halves(const uint16_t *place) {
#if LANES > 4
    if constexpr (W == 8)
        return Bits<8>(_mm256_cvtepu16_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i *>(place))));
#endif
    typename Vector<W>::Halves halves;
    std::memcpy(&halves, place, sizeof halves);
    return __builtin_convertvector(halves, Bits<W>);
}
template <int W> INLINE Floats<W> load(const Bfloat16 *place) { return Floats<W>(load_halves<W>(&place->bits) << 16); }
template <int W> INLINE Floats<W> load(const Float16 *place) {
#if LANES > 4
    if constexpr (W == 4) return Floats<4>(_mm_cvtph_ps(_mm_loadl_epi64(reinterpret_cast<const __m128i *>(place))));
    if constexpr (W == 8) return Floats<8>(_mm256_cvtph_ps(_mm_loadu_si128(reinterpret_cast<const __m128i *>(place))));
#endif
#if LANES == 16
    if constexpr (W == 16)
        return Floats<16>(_mm512_cvtph_ps(_mm256_loadu_si256(reinterpret_cast<const __m256i *>(place))));
#endif
    const Bits<W> bits = load_halves<W>(&place->bits);
    const Bits<W> finite = Bits<W>(Floats<W>((bits & 0x7fff) << 13) * 0x1p112f);
    const Bits<W> special = Bits<W>((bits & 0x7c00) == 0x7c00) & 0x7f800000u;
    return Floats<W>(finite | special | (bits & 0x8000) << 16);
}
template <class S> INLINE float to_float(const S &value) { return load<1>(&value)[0]; }

template <int W> INLINE Floats<W> clamped_lanes(Floats<W> values, float largest) {
#if LANES > 4
    if constexpr (W == 8) {  // of a NaN and a number these instructions choose the second
        const __m256 below = _mm256_min_ps(_mm256_set1_ps(largest), __m256(values));
        return Floats<8>(_mm256_max_ps(_mm256_set1_ps(-largest), below));
    }
#endif
    const Floats<W> below = values > largest ? Floats<W>{} + largest : values;
    return below < -largest ? Floats<W>{} - largest : below;
}

// Numbers are rounded to the nearest, of two to the even one. Finite ones stay finite: those beyond the type's largest
// number become that number.
template <int W> INLINE void store(float *place, Floats<W> values) { std::memcpy(place, &values, sizeof values); }
template <int W> INLINE void store_halves(uint16_t *place, Bits<W> bits) {
#if LANES > 4
    if constexpr (W == 8) {
        const __m256i all = __m256i(bits);
        const __m128i halves = _mm_packus_epi32(_mm256_castsi256_si128(all), _mm256_extracti128_si256(all, 1));
        _mm_storeu_si128(reinterpret_cast<__m128i *>(place), halves);
        return;
    }
#endif
    const auto halves = __builtin_convertvector(bits, typename Vector<W>::Halves);
    std::memcpy(place, &halves, sizeof halves);
}
template <int W> INLINE void store(Bfloat16 *place, Floats<W> values) {
    const Bits<W> bits = Bits<W>(clamped_lanes<W>(values, 0x1.fep127f));
    const Bits<W> rounded = (bits + 0x7fff + (bits >> 16 & 1)) >> 16;
    store_halves<W>(&place->bits, values == values ? rounded : Bits<W>{} + 0x7fc0);
}
template <int W> INLINE void store(Float16 *place, Floats<W> values) {
    const Floats<W> held = clamped_lanes<W>(values, 65504.0f);
#if LANES > 4
    if constexpr (W == 4) {
        _mm_storel_epi64(reinterpret_cast<__m128i *>(place), _mm_cvtps_ph(__m128(held), _MM_FROUND_TO_NEAREST_INT));
        return;
    }
    if constexpr (W == 8) {
        _mm_storeu_si128(reinterpret_cast<__m128i *>(place), _mm256_cvtps_ph(__m256(held), _MM_FROUND_TO_NEAREST_INT));
        return;
    }
#endif
#if LANES == 16
    if constexpr (W == 16) {
        _mm256_storeu_si256(reinterpret_cast<__m256i *>(place),
                            _mm512_cvtps_ph(__m512(held), _MM_FROUND_TO_NEAREST_INT));
        return;
    }
#endif
    const Bits<W> bits = Bits<W>(held), magnitude = bits & 0x7fffffff;
    const Bits<W> normal = (magnitude + 0xfff + (magnitude >> 13 & 1) - (112u << 23)) >> 13;
    const Bits<W> small = Bits<W>(Floats<W>(magnitude) + 0.5f) - to_bits(0.5f);  // rounds to units of 2^-24
    const Bits<W> rounded = (magnitude < (113u << 23) ? small : normal) | (bits >> 16 & 0x8000);
    store_halves<W>(&place->bits, values == values ? rounded : Bits<W>{} + 0x7e00);
}

// The numbers at these offsets: the compiler does not use the gather instruction by itself.
template <class S> INLINE Floats<LANES> gather_lanes(const S *first, const int32_t *offsets) {
    Floats<LANES> values;
    for (int lane = 0; lane < LANES; lane++) values[lane] = to_float(first[offsets[lane]]);
    return values;
}
#if LANES == 8
INLINE Floats<8> gather_lanes(const float *first, const int32_t *offsets) {
    return Floats<8>(_mm256_i32gather_ps(first, _mm256_loadu_si256(reinterpret_cast<const __m256i *>(offsets)), 4));
}
#elif LANES == 16
INLINE Floats<16> gather_lanes(const float *first, const int32_t *offsets) {
    return Floats<16>(_mm512_i32gather_ps(_mm512_loadu_si512(offsets), first, 4));
}
#endif

// Calls body(width, c) for vectors of channels that cover 0 to `channels`, wide ones first.
template <class Body> INLINE void over_channels(int64_t channels, Body body) {
    int64_t c = 0;
    for (; c + LANES <= channels; c += LANES) body(std::integral_constant<int, LANES>(), c);
    for (; c + 4 <= channels; c += 4) body(std::integral_constant<int, 4>(), c);
    for (; c < channels; c++) body(std::integral_constant<int, 1>(), c);
}

// Copies floats to or from numbers of any type.
template <class From, class To> INLINE void convert_row(const From *from, int64_t count, To *to) {
    over_channels(count, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        store<W>(to + c, load<W>(from + c));
    });
}

// One step of transposing a square block: exchanges its off-diagonal squares of K by K.
template <int K, class Row, int... I>
INLINE void exchange_squares(Row &a, Row &b, std::integer_sequence<int, I...>) {
    const Row first = __builtin_shufflevector(a, b, (I & K ? LANES + I - K : I)...);
    b = __builtin_shufflevector(a, b, (I & K ? LANES + I : I + K)...);
    a = first;
}

template <int K, class Row> INLINE void transpose_square(Row *rows) {
    if constexpr (K > 0) {
        for (int row = 0; row < LANES; row++)
            if (!(row & K)) exchange_squares<K>(rows[row], rows[row + K], std::make_integer_sequence<int, LANES>());
        transpose_square<K / 2>(rows);
    }
}

// to[column * to_step + row] = from[row * from_step + column], of floats or of the bits of halves
template <class T>
inline void transpose(const T *from, int64_t from_step, T *to, int64_t to_step, int64_t rows, int64_t columns) {
    typedef T Row __attribute__((vector_size(sizeof(T) * LANES)));
    typedef T Anywhere __attribute__((vector_size(sizeof(T) * LANES), aligned(sizeof(T)), may_alias));
    int64_t row = 0;
    for (; row + LANES <= rows; row += LANES) {
        int64_t column = 0;
        for (; column + LANES <= columns; column += LANES) {
            Row square[LANES];
            for (int r = 0; r < LANES; r++)
                square[r] = *reinterpret_cast<const Anywhere *>(from + (row + r) * from_step + column);
            transpose_square<LANES / 2>(square);
            for (int c = 0; c < LANES; c++)
                *reinterpret_cast<Anywhere *>(to + (column + c) * to_step + row) = square[c];
        }
        for (; column < columns; column++)
            for (int r = 0; r < LANES; r++) to[column * to_step + row + r] = from[(row + r) * from_step + column];
    }
    for (int64_t column = 0; column < columns; column++)
        for (int64_t r = row; r < rows; r++) to[column * to_step + r] = from[r * from_step + column];
}

INLINE float horizontal_sum(Floats<1> values) { return values[0]; }
INLINE float horizontal_sum(Floats<4> values) { return (values[0] + values[2]) + (values[1] + values[3]); }
INLINE float horizontal_sum(Floats<8> values) {
    return horizontal_sum(__builtin_shufflevector(values, values, 0, 1, 2, 3) +
                  __builtin_shufflevector(values, values, 4, 5, 6, 7));
}
INLINE float horizontal_sum(Floats<16> values) {
    return horizontal_sum(__builtin_shufflevector(values, values, 0, 1, 2, 3, 4, 5, 6, 7) +
                  __builtin_shufflevector(values, values, 8, 9, 10, 11, 12, 13, 14, 15));
}
