// Types and vectors. Included by resample.h.

constexpr int TILE = 64;
constexpr float OUTSIDE = -2.0f;                // an index all of whose taps lie outside
constexpr float LARGEST = 3.402823466e38f;
constexpr float SMALLEST_DEPTH = 0x1p-60f;
constexpr float LARGEST_COORDINATE = 0x1p100f;

// Types. Half-precision numbers are turned into float32 where they are read and back where they are written.

struct Bfloat16 { uint16_t bits; };
struct Float16 { uint16_t bits; };

inline float from_bits(uint32_t bits) { float value; std::memcpy(&value, &bits, 4); return value; }
inline uint32_t to_bits(float value) { uint32_t bits; std::memcpy(&bits, &value, 4); return bits; }

inline float load(float value) { return value; }
inline float load(Bfloat16 value) { return from_bits(uint32_t(value.bits) << 16); }
inline float load(Float16 value) {
    const uint32_t magnitude = uint32_t(value.bits & 0x7fff) << 13;
    const uint32_t finite = to_bits(from_bits(magnitude) * 0x1p112f);
    const uint32_t special = (value.bits & 0x7c00) == 0x7c00 ? 0x7f800000u : 0u;
    return from_bits(finite | special | uint32_t(value.bits & 0x8000) << 16);
}

inline float held(float value, float largest) {
    return value > largest ? largest : value < -largest ? -largest : value;
}

// Above this an output saturates and nothing comes back through it, as in `lsmgeo._dtypes.saturation_limit`.
inline float saturation_limit(int64_t type) {
    return type == FLOAT32 ? LARGEST : type == BFLOAT16 ? 0x1.fe7f8p127f : 0x1.ffcffep15f;
}

// What is finite stays finite: the largest number of the type stands for all above it.
inline void store(float *place, float value) { *place = value; }
inline void store(Bfloat16 *place, float value) {
    const uint32_t bits = to_bits(held(value, 0x1.fep127f));
    const uint32_t rounded = (bits + 0x7fff + (bits >> 16 & 1)) >> 16;
    place->bits = uint16_t(value == value ? rounded : 0x7fc0);
}
inline void store(Float16 *place, float value) {
    const uint32_t bits = to_bits(held(value, 65504.0f));
    const uint32_t magnitude = bits & 0x7fffffff;
    const uint32_t normal = (magnitude + 0xfff + (magnitude >> 13 & 1) - (112u << 23)) >> 13;
    const uint32_t small = to_bits(from_bits(magnitude) + 0.5f) - to_bits(0.5f);  // adding rounds to units of 2^-24
    const uint32_t rounded = (magnitude < (113u << 23) ? small : normal) | (bits >> 16 & 0x8000);
    place->bits = uint16_t(value == value ? rounded : 0x7e00);
}

// Vectors of W floats. The compiler cuts them to what the instruction set has; arithmetic on them is that of each lane.

template <int W> struct Vector {
    typedef float Floats __attribute__((vector_size(4 * W)));
    typedef int32_t Masks __attribute__((vector_size(4 * W)));
    typedef uint32_t Bits __attribute__((vector_size(4 * W)));
    typedef uint16_t Halves __attribute__((vector_size(2 * W)));
};
template <int W> using Floats = typename Vector<W>::Floats;
template <int W> using Masks = typename Vector<W>::Masks;
template <int W> using Bits = typename Vector<W>::Bits;

template <int W> INLINE Floats<W> read(const float *place) {
    Floats<W> values;
    std::memcpy(&values, place, sizeof values);
    return values;
}
template <int W> INLINE Bits<W> read_halves(const uint16_t *place) {
    typename Vector<W>::Halves halves;
    std::memcpy(&halves, place, sizeof halves);
    return __builtin_convertvector(halves, Bits<W>);
}
template <int W> INLINE Floats<W> read(const Bfloat16 *place) { return Floats<W>(read_halves<W>(&place->bits) << 16); }
template <int W> INLINE Floats<W> read(const Float16 *place) {
    const Bits<W> bits = read_halves<W>(&place->bits);
    const Bits<W> finite = Bits<W>(Floats<W>((bits & 0x7fff) << 13) * 0x1p112f);
    const Bits<W> special = Bits<W>((bits & 0x7c00) == 0x7c00) & 0x7f800000u;
    return Floats<W>(finite | special | (bits & 0x8000) << 16);
}
template <int W> INLINE void write(float *place, Floats<W> values) { std::memcpy(place, &values, sizeof values); }

// The numbers at these places: the compiler does not use the instruction for it by itself.
template <class S> INLINE Floats<LANES> read_at(const S *first, const int32_t *places) {
    Floats<LANES> values;
    for (int lane = 0; lane < LANES; lane++) values[lane] = load(first[places[lane]]);
    return values;
}
#if LANES == 8
INLINE Floats<8> read_at(const float *first, const int32_t *places) {
    return Floats<8>(_mm256_i32gather_ps(first, _mm256_loadu_si256(reinterpret_cast<const __m256i *>(places)), 4));
}
#elif LANES == 16
INLINE Floats<16> read_at(const float *first, const int32_t *places) {
    return Floats<16>(_mm512_i32gather_ps(_mm512_loadu_si512(places), first, 4));
}
#endif

// Calls body(width, c) for vectors of channels from 0 to `channels`, wide ones first.
template <class Body> INLINE void over_channels(int64_t channels, Body body) {
    int64_t c = 0;
    for (; c + LANES <= channels; c += LANES) body(std::integral_constant<int, LANES>(), c);
    for (; c + 4 <= channels; c += 4) body(std::integral_constant<int, 4>(), c);
    for (; c < channels; c++) body(std::integral_constant<int, 1>(), c);
}

// One step of turning a square block: exchanges its off-diagonal squares of K by K.
template <int K, int... I>
INLINE void exchange(Floats<LANES> &a, Floats<LANES> &b, std::integer_sequence<int, I...>) {
    const Floats<LANES> first = __builtin_shufflevector(a, b, (I & K ? LANES + I - K : I)...);
    b = __builtin_shufflevector(a, b, (I & K ? LANES + I : I + K)...);
    a = first;
}

template <int K> INLINE void turn(Floats<LANES> *rows) {
    if constexpr (K > 0) {
        for (int row = 0; row < LANES; row++)
            if (!(row & K)) exchange<K>(rows[row], rows[row + K], std::make_integer_sequence<int, LANES>());
        turn<K / 2>(rows);
    }
}

// to[column * to_step + row] = from[row * from_step + column]
inline void transpose(const float *from, int64_t from_step, float *to, int64_t to_step, int64_t rows, int64_t columns) {
    int64_t row = 0;
    for (; row + LANES <= rows; row += LANES) {
        int64_t column = 0;
        for (; column + LANES <= columns; column += LANES) {
            Floats<LANES> square[LANES];
            for (int r = 0; r < LANES; r++) square[r] = read<LANES>(from + (row + r) * from_step + column);
            turn<LANES / 2>(square);
            for (int c = 0; c < LANES; c++) write<LANES>(to + (column + c) * to_step + row, square[c]);
        }
        for (; column < columns; column++)
            for (int r = 0; r < LANES; r++) to[column * to_step + row + r] = from[(row + r) * from_step + column];
    }
    for (int64_t column = 0; column < columns; column++)
        for (int64_t r = row; r < rows; r++) to[column * to_step + r] = from[r * from_step + column];
}

INLINE float sum_of(Floats<1> values) { return values[0]; }
INLINE float sum_of(Floats<4> values) { return (values[0] + values[2]) + (values[1] + values[3]); }
INLINE float sum_of(Floats<8> values) {
    return sum_of(__builtin_shufflevector(values, values, 0, 1, 2, 3) +
                  __builtin_shufflevector(values, values, 4, 5, 6, 7));
}
INLINE float sum_of(Floats<16> values) {
    return sum_of(__builtin_shufflevector(values, values, 0, 1, 2, 3, 4, 5, 6, 7) +
                  __builtin_shufflevector(values, values, 8, 9, 10, 11, 12, 13, 14, 15));
}
