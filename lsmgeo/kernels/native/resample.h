// The arithmetic of all kernels, in float32. Included once for each instruction set, inside a namespace.
//
// Sites are visited in tiles: runs along one axis of the lattice. Of a tile the places in the source are found first, in
// loops that the compiler turns into vector code; then each site mixes the channels of its taps, again in vectors.

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

inline float held(float value, float largest) { return value > largest ? largest : value < -largest ? -largest : value; }

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
    return sum_of(__builtin_shufflevector(values, values, 0, 1, 2, 3) + __builtin_shufflevector(values, values, 4, 5, 6, 7));
}
INLINE float sum_of(Floats<16> values) {
    return sum_of(__builtin_shufflevector(values, values, 0, 1, 2, 3, 4, 5, 6, 7) +
                  __builtin_shufflevector(values, values, 8, 9, 10, 11, 12, 13, 14, 15));
}

// Geometry

struct Tile {
    int64_t scene, view, number;
    int64_t k, j, i;                // of the first site
    bool along_z;                   // the others follow in z, else in x
    float x[TILE], depth[TILE];     // of the lattice; depth is 1 / z
    float index[3][TILE];
    float inverse[TILE];            // images: 1 / (M q)_3 where in front
    float plane[3][TILE];           // volumes: the terms of M q in x, y and 1
    float distance[TILE];           // the depth channel
    float direction[3][TILE], shrink[TILE];  // the direction channels, and 1 / their vector's length
    float fraction[3][TILE], slope[3][TILE];
    float weight[8][TILE];          // of the taps, where all of them lie inside
    int32_t cell[3][TILE];
    int32_t front[TILE], visible[TILE], reads[TILE], whole[TILE];
};

inline double plane_z(const Call &call, const Tile &tile, int64_t k) {
    return call.z[tile.scene * call.z_stride[0] + tile.view * call.z_stride[1] + k * call.z_stride[2]];
}

// Directions G q / |G q|, and 0 where the vector is no longer than the rounding error of its terms.
inline void direct(const Call &call, const View &view, Tile &tile) {
    const int n = int(tile.number);
    const double y = call.y[tile.j];
    float vector[3][TILE], least[TILE];
    for (int row = 0; row < 3; row++) {
        const double *g = view.direction[row];
        if (tile.along_z) {
            const float base = float(g[0] * call.x[tile.i] + g[1] * y + g[3]);
            for (int s = 0; s < n; s++) vector[row][s] = float(g[2] * plane_z(call, tile, tile.k + s)) + base;
        } else {
            const float slope = float(g[0]), base = float(g[1] * y + g[2] * plane_z(call, tile, tile.k) + g[3]);
            for (int s = 0; s < n; s++) vector[row][s] = slope * tile.x[s] + base;
        }
    }
    for (int s = 0; s < n; s++) {
        const double z = plane_z(call, tile, tile.k + (tile.along_z ? s : 0));
        const float terms = 4.0f * 0x1p-23f * float(view.terms + view.terms_z * std::fabs(z));
        least[s] = terms * terms;
    }
    for (int s = 0; s < n; s++) {
        const float squares = vector[0][s] * vector[0][s] + vector[1][s] * vector[1][s] + vector[2][s] * vector[2][s];
        const bool away = squares > least[s] && !view.masked;
        tile.shrink[s] = away ? 1.0f / std::sqrt(away ? squares : 1.0f) : 0.0f;
        for (int row = 0; row < 3; row++) tile.direction[row][s] = vector[row][s] * tile.shrink[s];
    }
}

inline void project_images(const Call &call, const View &view, Tile &tile) {
    const int n = int(tile.number);
    const double y = call.y[tile.j], z = plane_z(call, tile, tile.k);
    const double unit = (call.projective ? z : 1.0) * view.scale;
    const float bound = float(call.near) * float(unit);
    const float threshold = view.masked ? INFINITY : bound > SMALLEST_DEPTH ? bound : SMALLEST_DEPTH;
    float base[3], slope[3];
    for (int row = 0; row < 3; row++) {
        const double *m = view.matrix[row];
        base[row] = float(m[1] * y + m[2] * z + m[3]);
        slope[row] = float(m[0]);
    }
    for (int s = 0; s < n; s++) {
        const float x = tile.x[s], height = slope[2] * x + base[2];
        const bool front = height > threshold;
        const float inverse = 1.0f / (front ? height : 1.0f);
        tile.front[s] = front;
        tile.inverse[s] = front ? inverse : 0.0f;
        tile.index[0][s] = front ? (slope[0] * x + base[0]) * inverse : OUTSIDE;
        tile.index[1][s] = front ? (slope[1] * x + base[1]) * inverse : OUTSIDE;
    }
    if (call.depth) {
        const double per_unit = view.masked ? 0.0 : 1.0 / unit;
        for (int s = 0; s < n; s++) {
            const double distance = double(slope[2] * tile.x[s] + base[2]) * per_unit;
            tile.distance[s] = float(distance > LARGEST ? LARGEST : distance < -LARGEST ? -LARGEST : distance);
        }
    }
}

inline void read_pixels(const Call &call, Tile &tile) {
    const int64_t first = (tile.scene * call.views + tile.view) * call.sites[0] + tile.i;
    for (int s = 0; s < int(tile.number); s++) {
        const bool front = call.front[first + s] != 0;
        tile.front[s] = front;
        tile.index[0][s] = front ? call.pixels[2 * (first + s)] : OUTSIDE;
        tile.index[1][s] = front ? call.pixels[2 * (first + s) + 1] : OUTSIDE;
    }
}

inline void project_volumes(const Call &call, const View &view, Tile &tile) {
    const int n = int(tile.number);
    const double y = call.y[tile.j];
    for (int s = 0; s < n; s++) {
        const double depth = 1.0 / plane_z(call, tile, tile.k + (tile.along_z ? s : 0));
        tile.depth[s] = float(depth > LARGEST ? LARGEST : depth);
    }
    for (int s = 0; s < n; s++) tile.front[s] = tile.depth[s] > float(call.near) && !view.masked;
    for (int row = 0; row < 3; row++) {
        const double *m = view.matrix[row];
        const float slope = float(m[0]), base = float(m[1] * y + m[3]), offset = float(m[2]);
        for (int s = 0; s < n; s++) {
            const float plane = held(slope * tile.x[s] + base, LARGEST_COORDINATE);
            tile.plane[row][s] = plane;
            tile.index[row][s] = tile.front[s] ? plane * tile.depth[s] + offset : OUTSIDE;
        }
    }
    if (call.depth)
        for (int s = 0; s < n; s++) tile.distance[s] = view.masked ? 0.0f : tile.depth[s];
}

// From indices to cells and fractions; which sites are visible, which read anything, which find all their taps inside.
template <int DIMS>
inline void settle(const Call &call, Tile &tile) {
    const int n = int(tile.number);
    const bool nearest = call.nearest != 0, border = call.border != 0;
    for (int s = 0; s < n; s++) tile.visible[s] = tile.reads[s] = tile.whole[s] = tile.front[s];
    for (int axis = 0; axis < DIMS; axis++) {
        const float size = float(call.size[axis]), least = nearest ? 0.0f : -1.0f;
        const float low = border ? 0.0f : OUTSIDE, high = border ? size - 1.0f : size + 1.0f;
        for (int s = 0; s < n; s++) {
            const float index = tile.index[axis][s];
            const float inside = index < low ? low : index > high ? high : index;
            const float floor = std::floor(inside), fraction = inside - floor;
            const float cell = nearest && fraction >= 0.5f ? floor + 1.0f : floor;
            tile.cell[axis][s] = int32_t(cell);
            tile.fraction[axis][s] = fraction;
            tile.visible[s] &= int32_t(index >= -0.5f) & int32_t(index < size - 0.5f);
            tile.reads[s] &= int32_t(cell >= least) & int32_t(cell < size);
            tile.whole[s] &= int32_t(cell >= 0.0f) & int32_t(cell < size - 1.0f);
        }
        if (border) {
            for (int s = 0; s < n; s++) {
                const float index = tile.index[axis][s];
                tile.slope[axis][s] = index > 0.0f && index < size - 1.0f ? 1.0f : 0.0f;
            }
        } else {
            for (int s = 0; s < n; s++) tile.slope[axis][s] = 1.0f;
        }
    }
    if (nearest) return;
    for (int s = 0; s < n; s++) {
        const float x = tile.fraction[0][s], y = tile.fraction[1][s], z = DIMS == 3 ? tile.fraction[2][s] : 0.0f;
        const float near = DIMS == 3 ? (1.0f - y) * (1.0f - z) : 1.0f - y, next = DIMS == 3 ? y * (1.0f - z) : y;
        tile.weight[0][s] = (1.0f - x) * near;
        tile.weight[1][s] = x * near;
        tile.weight[2][s] = (1.0f - x) * next;
        tile.weight[3][s] = x * next;
        if (DIMS == 3) {
            tile.weight[4][s] = (1.0f - x) * (1.0f - y) * z;
            tile.weight[5][s] = x * (1.0f - y) * z;
            tile.weight[6][s] = (1.0f - x) * y * z;
            tile.weight[7][s] = x * y * z;
        }
    }
}

template <int DIMS>
inline void locate(const Call &call, const View &view, Tile &tile) {
    if (call.kind != PIXELS)
        for (int s = 0; s < int(tile.number); s++) tile.x[s] = float(call.x[tile.i + (tile.along_z ? 0 : s)]);
    if (DIMS == 3) project_volumes(call, view, tile);
    else if (call.kind == PIXELS) read_pixels(call, tile);
    else project_images(call, view, tile);
    if (call.direction) direct(call, view, tile);
    settle<DIMS>(call, tile);
}

// Taps: the cells that a site mixes. Almost all sites have 2^DIMS of them inside the source, which is the fast case, or,
// in nearest sampling, one. At the source's edge taps are taken one by one.

template <int DIMS>
INLINE int64_t corner_of(const Tile &tile, int s, const int64_t *stride) {
    int64_t corner = tile.cell[0][s] * stride[0] + tile.cell[1][s] * stride[1];
    if (DIMS == 3) corner += tile.cell[2][s] * stride[2];
    return corner;
}

INLINE int64_t step_to(int tap, const int64_t *stride) {
    return (tap & 1 ? stride[0] : 0) + (tap & 2 ? stride[1] : 0) + (tap & 4 ? stride[2] : 0);
}

template <int DIMS>
INLINE bool is_inside(const Call &call, const Tile &tile, int s, int tap) {
    bool inside = true;
    for (int axis = 0; axis < DIMS; axis++) {
        const int32_t cell = tile.cell[axis][s] + (tap >> axis & 1);
        inside = inside && cell >= 0 && cell < call.size[axis];
    }
    return inside;
}

// The weight of a tap, without the factors of the axes in `without` (a bit each).
template <int DIMS>
INLINE float weight_of(const Tile &tile, int s, int tap, int without = 0) {
    float weight = 1.0f;
    for (int axis = 0; axis < DIMS; axis++)
        if (!(without >> axis & 1)) weight *= tap >> axis & 1 ? tile.fraction[axis][s] : 1.0f - tile.fraction[axis][s];
    return weight;
}

// out (+)= sum of N taps times their weights.
template <int N, class S>
INLINE void mix(const S *const *place, const float *weight, int64_t channels, float *out, bool add) {
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        Floats<W> sum = weight[0] * read<W>(place[0] + c);
        if (add) sum += read<W>(out + c);
        for (int tap = 1; tap < N; tap++) sum += weight[tap] * read<W>(place[tap] + c);
        write<W>(out + c, sum);
    });
}

// The value at site s, by a factor; added to what is there if asked.
template <int DIMS, class S>
inline void gather(const Call &call, const Tile &tile, int s, const S *source, const int64_t *stride, int64_t channels,
                   float *out, float factor = 1.0f, bool add = false) {
    constexpr int N = 1 << DIMS;
    if (!tile.reads[s]) {
        if (!add) std::memset(out, 0, size_t(channels) * sizeof(float));
        return;
    }
    const S *corner = source + corner_of<DIMS>(tile, s, stride);
    if (call.nearest) return mix<1>(&corner, &factor, channels, out, add);
    if (tile.whole[s]) {
        const S *place[N];
        float weight[N];
        for (int tap = 0; tap < N; tap++) {
            place[tap] = corner + step_to(tap, stride);
            weight[tap] = tile.weight[tap][s] * factor;
        }
        return mix<N>(place, weight, channels, out, add);
    }
    for (int tap = 0; tap < N; tap++) {
        if (!is_inside<DIMS>(call, tile, s, tap)) continue;
        const S *place = corner + step_to(tap, stride);
        const float weight = weight_of<DIMS>(tile, s, tap) * factor;
        mix<1>(&place, &weight, channels, out, add);
        add = true;
    }
}

template <int N>
INLINE void spread(float *const *place, const float *weight, int64_t channels, const float *gradient) {
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        const Floats<W> part = read<W>(gradient + c);
        for (int tap = 0; tap < N; tap++) write<W>(place[tap] + c, read<W>(place[tap] + c) + weight[tap] * part);
    });
}

// The transpose of `gather`: adds the gradient by the value at site s to that of the source.
template <int DIMS>
inline void scatter(const Call &call, const Tile &tile, int s, float *source, const int64_t *stride, int64_t channels,
                    const float *gradient, float factor = 1.0f) {
    constexpr int N = 1 << DIMS;
    if (!tile.reads[s]) return;
    float *corner = source + corner_of<DIMS>(tile, s, stride);
    if (call.nearest) return spread<1>(&corner, &factor, channels, gradient);
    if (tile.whole[s]) {
        float *place[N];
        float weight[N];
        for (int tap = 0; tap < N; tap++) {
            place[tap] = corner + step_to(tap, stride);
            weight[tap] = tile.weight[tap][s] * factor;
        }
        return spread<N>(place, weight, channels, gradient);
    }
    for (int tap = 0; tap < N; tap++) {
        if (!is_inside<DIMS>(call, tile, s, tap)) continue;
        float *place = corner + step_to(tap, stride);
        const float weight = weight_of<DIMS>(tile, s, tap) * factor;
        spread<1>(&place, &weight, channels, gradient);
    }
}

// The gradient by the index of site s from that by its value: each tap by the slope of its weight, times the gradient,
// summed over the channels.
template <int N, int DIMS, class S>
INLINE void agree(const S *const *place, const float (*slope)[DIMS], int64_t channels, const float *gradient, float *sums) {
    Floats<LANES> wide[DIMS] = {};
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        const Floats<W> by_value = read<W>(gradient + c);
        Floats<W> by_index[DIMS] = {};
        for (int tap = 0; tap < N; tap++) {
            const Floats<W> value = read<W>(place[tap] + c);
            for (int axis = 0; axis < DIMS; axis++) by_index[axis] += slope[tap][axis] * value;
        }
        for (int axis = 0; axis < DIMS; axis++) {
            if constexpr (W == LANES) wide[axis] += by_index[axis] * by_value;
            else sums[axis] += sum_of(by_index[axis] * by_value);
        }
    });
    for (int axis = 0; axis < DIMS; axis++) sums[axis] += sum_of(wide[axis]);
}

template <int DIMS, class S>
inline void place_gradient(const Call &call, const Tile &tile, int s, const S *source, const int64_t *stride,
                           int64_t channels, const float *gradient, float (*by_index)[TILE]) {
    constexpr int N = 1 << DIMS;
    float sums[DIMS] = {};
    if (tile.reads[s] && !call.nearest) {
        const S *corner = source + corner_of<DIMS>(tile, s, stride), *place[N];
        float slope[N][DIMS];
        for (int tap = 0; tap < N; tap++) {
            place[tap] = corner + step_to(tap, stride);
            for (int axis = 0; axis < DIMS; axis++) {
                const float rest = weight_of<DIMS>(tile, s, tap, 1 << axis) * tile.slope[axis][s];
                slope[tap][axis] = tap >> axis & 1 ? rest : -rest;
            }
        }
        if (tile.whole[s]) {
            agree<N, DIMS>(place, slope, channels, gradient, sums);
        } else {
            for (int tap = 0; tap < N; tap++)
                if (is_inside<DIMS>(call, tile, s, tap))
                    agree<1, DIMS>(place + tap, slope + tap, channels, gradient, sums);
        }
    }
    for (int axis = 0; axis < DIMS; axis++) by_index[axis][s] = sums[axis];
}

// Blocks of values

struct Layout { int64_t base, site, channel; };

inline Layout layout(const int64_t *stride, const Tile &tile) {
    const int64_t base = tile.scene * stride[0] + tile.view * stride[1] + tile.k * stride[3] + tile.j * stride[4] +
                         tile.i * stride[5];
    return {base, tile.along_z ? stride[3] : stride[5], stride[2]};
}

template <class S>
inline void store_block(S *values, const Layout &at, int64_t sites, int64_t channels, const float *block) {
    S *first = values + at.base;
    if (at.channel == 1) {
        for (int64_t s = 0; s < sites; s++)
            for (int64_t c = 0; c < channels; c++) store(first + s * at.site + c, block[s * channels + c]);
    } else if (at.site == 1) {
        for (int64_t c = 0; c < channels; c++)
            for (int64_t s = 0; s < sites; s++) store(first + c * at.channel + s, block[s * channels + c]);
    } else {
        for (int64_t s = 0; s < sites; s++)
            for (int64_t c = 0; c < channels; c++) store(first + s * at.site + c * at.channel, block[s * channels + c]);
    }
}

inline void put(const Call &call, const Layout &at, int64_t sites, int64_t channels, const float *block) {
    if (call.values_type == FLOAT32 && at.site == 1)
        transpose(block, channels, static_cast<float *>(call.values) + at.base, at.channel, sites, channels);
    else if (call.values_type == FLOAT32) store_block(static_cast<float *>(call.values), at, sites, channels, block);
    else if (call.values_type == BFLOAT16) store_block(static_cast<Bfloat16 *>(call.values), at, sites, channels, block);
    else store_block(static_cast<Float16 *>(call.values), at, sites, channels, block);
}

template <class S>
inline void load_block(const S *values, const Layout &at, int64_t sites, int64_t channels, float *block) {
    const S *first = values + at.base;
    if (at.channel == 1)
        for (int64_t s = 0; s < sites; s++)
            for (int64_t c = 0; c < channels; c++) block[s * channels + c] = load(first[s * at.site + c]);
    else
        for (int64_t c = 0; c < channels; c++)
            for (int64_t s = 0; s < sites; s++) block[s * channels + c] = load(first[s * at.site + c * at.channel]);
}

// A block of the incoming gradient: (sites, channels) with a step from site to site, in place where that is possible.
struct Block { const float *first; int64_t step; };

inline Block take(const Call &call, const Tile &tile, int64_t channel, int64_t channels, float *room) {
    Layout at = layout(call.gradient_stride, tile);
    at.base += channel * at.channel;
    if (call.gradient_type == FLOAT32) {
        const float *values = static_cast<const float *>(call.gradient);
        if (at.channel == 1) return {values + at.base, at.site};
        if (at.site == 1) transpose(values + at.base, at.channel, room, channels, channels, tile.number);
        else load_block(values, at, tile.number, channels, room);
    } else if (call.gradient_type == BFLOAT16) {
        load_block(static_cast<const Bfloat16 *>(call.gradient), at, tile.number, channels, room);
    } else {
        load_block(static_cast<const Float16 *>(call.gradient), at, tile.number, channels, room);
    }
    return {room, channels};
}

inline void show(const Call &call, const Tile &tile) {
    const int64_t *n = call.sites;
    const int64_t at = (((tile.scene * call.views + tile.view) * n[2] + tile.k) * n[1] + tile.j) * n[0] + tile.i;
    const int64_t step = tile.along_z ? n[0] * n[1] : 1;
    for (int64_t s = 0; s < tile.number; s++) call.visible[at + s * step] = tile.visible[s];
}

// The channels that geometry gives: depth, direction, extras; `step` floats from one to the next.
inline void append(const Call &call, const Tile &tile, int s, float *out) {
    if (call.depth) *out++ = tile.distance[s];
    if (call.direction)
        for (int row = 0; row < 3; row++) *out++ = tile.direction[row][s];
    if (call.extra) {
        const int64_t site = (tile.scene * call.views + tile.view) * call.sites[0] + tile.i + s;
        std::memcpy(out, call.extras + site * call.extra, size_t(call.extra) * sizeof(float));
    }
}

inline const View &view_of(const Plan &plan, const Tile &tile) {
    return plan.views[tile.scene * plan.call->views + tile.view];
}

inline void start(const Plan &plan, Tile &tile, int64_t scene, int64_t view, int64_t number) {
    const Call &call = *plan.call;
    const int64_t row = number / plan.tiles_per_row, part = number % plan.tiles_per_row;
    const int64_t length = plan.along_z ? call.sites[2] : call.sites[0];
    const int64_t first = part * length / plan.tiles_per_row, last = (part + 1) * length / plan.tiles_per_row;
    tile.scene = scene;
    tile.view = view;
    tile.number = last - first;
    tile.along_z = plan.along_z;
    tile.k = plan.along_z ? first : row / call.sites[1];
    tile.j = plan.along_z ? row / call.sites[0] : row % call.sites[1];
    tile.i = plan.along_z ? row % call.sites[0] : first;
}

template <class S>
inline const S *source_of(const Call &call, int64_t scene, int64_t view) {
    return static_cast<const S *>(call.source) + scene * call.source_stride[0] + view * call.source_stride[1];
}

inline float *gradient_of(const Call &call, int64_t scene, int64_t view) {
    return call.source_gradient + scene * call.source_gradient_stride[0] + view * call.source_gradient_stride[1];
}

inline void axis_strides(const int64_t *stride, int64_t *axes) {  // to the order x, y, z
    axes[0] = stride[4];
    axes[1] = stride[3];
    axes[2] = stride[2];
}

// Whether no site of a tile in a volume's lattice reads anything, seen from its two ends: indices change along a tile in
// one direction. Much of a sweep lies beside the volume. Nothing is lost by a "no"; the margin is beyond rounding.
inline bool is_beside(const Call &call, const View &view, const Tile &tile) {
    if (call.kind != VOLUMES) return false;
    if (view.masked) return true;
    if (call.border) return false;
    const int64_t last = tile.number - 1;
    double index[3][2];
    for (int end = 0; end < 2; end++) {
        const double x = call.x[tile.i + (tile.along_z ? 0 : end * last)], y = call.y[tile.j];
        const double depth = 1.0 / plane_z(call, tile, tile.k + (tile.along_z ? end * last : 0));
        for (int row = 0; row < 3; row++) {
            const double *m = view.matrix[row];
            index[row][end] = (m[0] * x + m[1] * y + m[3]) * depth + m[2];
        }
    }
    for (int axis = 0; axis < 3; axis++) {
        const double high = double(call.size[axis]) + 0.01;
        if (index[axis][0] < -1.01 && index[axis][1] < -1.01) return true;
        if (index[axis][0] > high && index[axis][1] > high) return true;
    }
    return false;
}

// Zeros for a whole tile that nobody sees.
inline void blank(const Call &call, const Tile &tile, const Layout &at) {
    const int64_t n = call.sites[0] * call.sites[1], *size = call.sites;
    const int64_t first = (((tile.scene * call.views + tile.view) * size[2] + tile.k) * size[1] + tile.j) * size[0] + tile.i;
    for (int64_t s = 0; s < tile.number; s++) call.visible[first + s * (tile.along_z ? n : 1)] = 0;
    float *out = static_cast<float *>(call.values) + at.base;
    if (at.channel == 1 && at.site == call.channels) {
        std::memset(out, 0, size_t(tile.number * call.channels) * sizeof(float));
    } else if (at.site == 1) {
        for (int64_t c = 0; c < call.channels; c++)
            std::memset(out + c * at.channel, 0, size_t(tile.number) * sizeof(float));
    } else {
        for (int64_t s = 0; s < tile.number; s++)
            for (int64_t c = 0; c < call.channels; c++) out[s * at.site + c * at.channel] = 0.0f;
    }
}

// Forward, every view by itself: tiles first to last of one view.
template <int DIMS, class S>
void sample(const Plan &plan, int64_t scene, int64_t view, int64_t first, int64_t last, Room &room) {
    const Call &call = *plan.call;
    Tile &tile = *static_cast<Tile *>(room.tiles);
    int64_t axes[3];
    axis_strides(call.source_stride, axes);
    const S *source = source_of<S>(call, scene, view);
    const int64_t channels = plan.channels;
    for (int64_t number = first; number < last; number++) {
        start(plan, tile, scene, view, number);
        const Layout at = layout(call.values_stride, tile);
        if (channels == call.channels && call.values_type == FLOAT32 && is_beside(call, view_of(plan, tile), tile)) {
            blank(call, tile, at);
            continue;
        }
        locate<DIMS>(call, view_of(plan, tile), tile);
        show(call, tile);
        const bool direct = call.values_type == FLOAT32 && at.channel == 1;
        float *out = direct ? static_cast<float *>(call.values) + at.base : room.values;
        const int64_t step = direct ? at.site : channels;
        for (int s = 0; s < int(tile.number); s++) {
            gather<DIMS>(call, tile, s, source, axes, call.channels, out + s * step);
            append(call, tile, s, out + s * step + call.channels);
        }
        if (!direct) put(call, at, tile.number, channels, room.values);
    }
}

// Statistics of one site

// The values of the views that see site s, one after another in room.values; returns how many, and who they are.
template <class S>
inline int64_t visible_values(const Plan &plan, const Tile *tiles, int s, int64_t channel, int64_t channels,
                              bool geometry, Room &room) {
    const Call &call = *plan.call;
    const int64_t step = channels + (geometry ? plan.channels - call.channels : 0);
    int64_t axes[3], count = 0;
    axis_strides(call.source_stride, axes);
    for (int64_t v = 0; v < call.views; v++) {
        if (!tiles[v].visible[s]) continue;
        float *out = room.values + count * step;
        const S *source = source_of<S>(call, tiles[v].scene, v) + channel;
        gather<2>(call, tiles[v], s, source, axes, channels, out);
        if (geometry) append(call, tiles[v], s, out + channels);
        room.seen[count++] = v;
    }
    return count;
}

constexpr float LARGEST_ROOT = 0x1.fffffep63f;  // the square root of the largest float

template <int W> INLINE Floats<W> held_lanes(Floats<W> values, float largest) {
    const Floats<W> below = values > largest ? Floats<W>{} + largest : values;
    return below < -largest ? Floats<W>{} - largest : below;
}

template <int W> INLINE Floats<W> mean_of(const float *values, int64_t count, int64_t step) {
    const float share = 1.0f / float(count);
    Floats<W> mean = {};
    for (int64_t v = 0; v < count; v++) mean += read<W>(values + v * step) * share;
    return mean;
}

// The first of the views that has the largest value, a NaN above all, and that value.
template <int W> INLINE Masks<W> best_of(const float *values, int64_t count, int64_t step, Floats<W> &best) {
    best = read<W>(values);
    Masks<W> first = {};
    for (int64_t v = 1; v < count; v++) {
        const Floats<W> value = read<W>(values + v * step);
        const Masks<W> stays = (value <= best) | (best != best);
        best = stays ? best : value;
        first = stays ? first : Masks<W>{} + int32_t(v);
    }
    return first;
}

// Statistics of `count` rows of values, one block of channels after another.
inline void summarise(const Call &call, const float *values, int64_t count, int64_t channels, float *out) {
    if (count == 0) {
        std::memset(out, 0, size_t(call.statistics * channels) * sizeof(float));
        return;
    }
    const float share = 1.0f / float(count);
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        const float *first = values + c;
        for (int64_t block = 0; block < call.statistics; block++) {
            Floats<W> result = {};
            if (call.statistic[block] == MAX) {
                best_of<W>(first, count, channels, result);
            } else {
                result = mean_of<W>(first, count, channels);
                if (call.statistic[block] == VARIANCE) {
                    const Floats<W> mean = result;
                    result = Floats<W>{};
                    for (int64_t v = 0; v < count; v++) {
                        const Floats<W> apart = held_lanes<W>(read<W>(first + v * channels) - mean, LARGEST_ROOT);
                        result += apart * apart * share;
                    }
                    result = held_lanes<W>(result, LARGEST);
                }
            }
            write<W>(out + block * channels + c, result);
        }
    });
}

// Forward with the views reduced: tiles first to last of one scene.
template <class S>
void reduce(const Plan &plan, int64_t scene, int64_t first, int64_t last, Room &room) {
    const Call &call = *plan.call;
    Tile *tiles = static_cast<Tile *>(room.tiles);
    const int64_t channels = plan.channels, total = call.statistics * channels;
    const bool only_mean = call.statistics == 1 && call.statistic[0] == MEAN && channels == call.channels;
    int64_t axes[3];
    axis_strides(call.source_stride, axes);
    for (int64_t number = first; number < last; number++) {
        for (int64_t v = 0; v < call.views; v++) {
            start(plan, tiles[v], scene, v, number);
            locate<2>(call, view_of(plan, tiles[v]), tiles[v]);
            show(call, tiles[v]);
        }
        const Layout at = layout(call.values_stride, tiles[0]);
        const bool direct = call.values_type == FLOAT32 && at.channel == 1;
        for (int s = 0; s < int(tiles[0].number); s++) {
            float *out = direct ? static_cast<float *>(call.values) + at.base + s * at.site : room.reduced + s * total;
            if (only_mean) {
                int64_t count = 0;
                for (int64_t v = 0; v < call.views; v++) count += tiles[v].visible[s];
                bool add = false;
                for (int64_t v = 0; v < call.views; v++) {
                    if (!tiles[v].visible[s]) continue;
                    const S *source = source_of<S>(call, scene, v);
                    gather<2>(call, tiles[v], s, source, axes, channels, out, 1.0f / float(count), add);
                    add = true;
                }
                if (!add) std::memset(out, 0, size_t(channels) * sizeof(float));
                continue;
            }
            const int64_t count = visible_values<S>(plan, tiles, s, 0, call.channels, true, room);
            summarise(call, room.values, count, channels, out);
        }
        if (!direct) put(call, at, tiles[0].number, total, room.reduced);
    }
}

// Backward

// Sums over a tile of what its sites say about the matrices and z; gradients by M q, by G q and by the place in z.
struct Sums {
    double *matrix, *direction, *z;
};

// By (M q) / z for images and by (M q) / s for volumes, both with respect to the terms of M q.
inline void collect(const Plan &plan, const Tile &tile, const float (*by_index)[TILE], const float *by_distance,
                    const float (*by_direction)[TILE], const Sums &sums) {
    const Call &call = *plan.call;
    const View &view = view_of(plan, tile);
    const int n = int(tile.number);
    const double y = call.y[tile.j];
    float by_z[TILE];  // by z through the matrix, where z varies along the tile or is one for all
    for (int s = 0; s < n; s++) by_z[s] = 0.0f;
    double extra_z = 0.0;
    const bool volumes = call.kind == VOLUMES;
    if (!volumes) {
        const double z = plane_z(call, tile, tile.k);
        const double unit = (call.projective ? z : 1.0) * view.scale;
        float rows[3][TILE];
        for (int s = 0; s < n; s++) {
            rows[0][s] = by_index[0][s] * tile.inverse[s];
            rows[1][s] = by_index[1][s] * tile.inverse[s];
            rows[2][s] = 0.0f;
        }
        for (int s = 0; s < n; s++)
            if (rows[0][s] != 0.0f || rows[1][s] != 0.0f)
                rows[2][s] = -(rows[0][s] * tile.index[0][s] + rows[1][s] * tile.index[1][s]);
        if (call.depth && !view.masked)
            for (int s = 0; s < n; s++) {
                const bool free = tile.distance[s] < LARGEST && tile.distance[s] > -LARGEST;
                const double by_height = free ? by_distance[s] / unit : 0.0;
                rows[2][s] += float(by_height);
                if (call.projective) extra_z -= by_height * double(tile.distance[s]) * view.scale;
            }
        for (int row = 0; row < 3; row++) {
            float sum = 0.0f, sum_x = 0.0f;
            for (int s = 0; s < n; s++) {
                sum += rows[row][s];
                sum_x += rows[row][s] * tile.x[s];
            }
            if (sums.matrix) {
                double *to = sums.matrix + 4 * row;
                to[0] += view.scale * double(sum_x);
                to[1] += view.scale * double(sum) * y;
                to[2] += view.scale * double(sum) * z;
                to[3] += view.scale * double(sum);
            }
            extra_z += view.matrix[row][2] * double(sum);
        }
    } else {
        for (int row = 0; row < 3; row++) {
            float sum = 0.0f, sum_x = 0.0f, sum_offset = 0.0f;
            for (int s = 0; s < n; s++) {
                const float by_plane = by_index[row][s] * tile.depth[s];
                const float free = std::fabs(tile.plane[row][s]) < LARGEST_COORDINATE ? by_plane : 0.0f;
                sum += free;
                sum_x += free * tile.x[s];
                sum_offset += by_index[row][s];
                by_z[s] -= by_plane * tile.plane[row][s] * tile.depth[s];
            }
            if (sums.matrix) {
                double *to = sums.matrix + 4 * row;
                to[0] += sum_x;
                to[1] += double(sum) * y;
                to[2] += sum_offset;
                to[3] += sum;
            }
        }
        if (call.depth && !view.masked)
            for (int s = 0; s < n; s++) by_z[s] -= by_distance[s] * tile.depth[s] * tile.depth[s];
    }
    if (call.direction && !view.masked) {
        float rows[3][TILE];
        for (int s = 0; s < n; s++) {
            float along = 0.0f;
            for (int row = 0; row < 3; row++) along += by_direction[row][s] * tile.direction[row][s];
            for (int row = 0; row < 3; row++)
                rows[row][s] = (by_direction[row][s] - along * tile.direction[row][s]) * tile.shrink[s];
        }
        for (int row = 0; row < 3; row++) {
            const double inner = view.direction[row][2];
            double sum = 0.0, sum_x = 0.0, sum_z = 0.0;
            for (int s = 0; s < n; s++) {
                sum += rows[row][s];
                sum_x += double(rows[row][s]) * tile.x[s];
                sum_z += double(rows[row][s]) * plane_z(call, tile, tile.k + (tile.along_z ? s : 0));
                by_z[s] += float(rows[row][s] * inner);
            }
            if (sums.direction) {
                double *to = sums.direction + 4 * row;
                to[0] += view.direction_scale * sum_x;
                to[1] += view.direction_scale * sum * y;
                to[2] += view.direction_scale * sum_z;
                to[3] += view.direction_scale * sum;
            }
        }
    }
    if (sums.z) {
        sums.z[tile.k] += extra_z;
        for (int s = 0; s < n; s++) sums.z[tile.k + (tile.along_z ? s : 0)] += by_z[s];
    }
}

// The parts of the incoming gradient that belong to geometric channels, site by site.
struct Geometric {
    float by_index[3][TILE], by_distance[TILE], by_direction[3][TILE];
};

inline void split(const Call &call, const Tile &tile, int s, const float *gradient, Geometric &geometric) {
    if (call.depth) geometric.by_distance[s] = *gradient++;
    if (call.direction)
        for (int row = 0; row < 3; row++) geometric.by_direction[row][s] = *gradient++;
    if (call.extra && call.extras_gradient) {
        const int64_t site = (tile.scene * call.views + tile.view) * call.sites[0] + tile.i + s;
        std::memcpy(call.extras_gradient + site * call.extra, gradient, size_t(call.extra) * sizeof(float));
    }
}

inline void clear(const Call &call, int64_t scene, int64_t view, int64_t channel, int64_t channels) {
    if (!call.source_gradient || call.accumulate) return;
    float *first = gradient_of(call, scene, view) + channel;
    const int64_t *stride = call.source_gradient_stride;
    for (int64_t z = 0; z < call.size[2]; z++)
        for (int64_t y = 0; y < call.size[1]; y++)
            for (int64_t x = 0; x < call.size[0]; x++)
                std::memset(first + z * stride[2] + y * stride[3] + x * stride[4], 0, size_t(channels) * sizeof(float));
}

inline Sums sums_of(const Call &call, int64_t scene, int64_t view, int64_t chunk) {
    const int64_t at = (scene * call.views + view) * call.chunks + chunk;
    return {call.matrix_gradient ? call.matrix_gradient + 12 * at : nullptr,
            call.direction_gradient ? call.direction_gradient + 12 * at : nullptr,
            call.z_gradient ? call.z_gradient + call.sites[2] * at : nullptr};
}

inline void finish(const Plan &plan, const Tile &tile, int64_t chunk, const Geometric &geometric) {
    const Call &call = *plan.call;
    if (call.kind != PIXELS) {
        const Sums sums = sums_of(call, tile.scene, tile.view, chunk);
        if (sums.matrix || sums.direction || sums.z)
            collect(plan, tile, geometric.by_index, geometric.by_distance, geometric.by_direction, sums);
    } else if (call.pixels_gradient) {
        const int64_t at = ((chunk * call.scenes + tile.scene) * call.views + tile.view) * call.sites[0] + tile.i;
        for (int64_t s = 0; s < tile.number; s++)
            for (int axis = 0; axis < 2; axis++)
                call.pixels_gradient[2 * (at + s) + axis] = geometric.by_index[axis][s];
    }
}

// Backward of `sample`: all sites of one view, one chunk of the channels. The last chunk has the geometric channels too.
template <int DIMS, class S>
void sample_backward(const Plan &plan, int64_t scene, int64_t view, int64_t chunk, Room &room) {
    const Call &call = *plan.call;
    Tile &tile = *static_cast<Tile *>(room.tiles);
    int64_t axes[3], to_axes[3];
    axis_strides(call.source_stride, axes);
    axis_strides(call.source_gradient_stride, to_axes);
    const int64_t channel = chunk * call.channels / call.chunks;
    const int64_t channels = (chunk + 1) * call.channels / call.chunks - channel;
    const int64_t appended = plan.channels - call.channels;
    const bool geometry = chunk + 1 == call.chunks && appended > 0;
    const bool places = call.matrix_gradient || call.z_gradient || call.pixels_gradient;
    const S *source = source_of<S>(call, scene, view) + channel;
    float *to = call.source_gradient ? gradient_of(call, scene, view) + channel : nullptr;
    Geometric geometric = {};
    if (DIMS == 2) clear(call, scene, view, channel, channels);
    for (int64_t number = 0; number < plan.tiles; number++) {
        start(plan, tile, scene, view, number);
        locate<DIMS>(call, view_of(plan, tile), tile);
        const Block block = take(call, tile, channel, channels, room.values);
        for (int s = 0; s < int(tile.number); s++) {
            const float *gradient = block.first + s * block.step;
            if (places) place_gradient<DIMS>(call, tile, s, source, axes, channels, gradient, geometric.by_index);
            if (to) scatter<DIMS>(call, tile, s, to, to_axes, channels, gradient);
        }
        if (geometry) {
            const Block last = take(call, tile, call.channels, appended, room.values);
            for (int s = 0; s < int(tile.number); s++) split(call, tile, s, last.first + s * last.step, geometric);
        }
        finish(plan, tile, chunk, geometric);
    }
}

// From the gradient by the statistics of one site to that by the values of each view that sees it.
inline void unsummarise(const Call &call, const float *values, int64_t count, int64_t channels,
                        const float *const *gradients, float *out) {
    if (count == 0) return;
    const float share = 1.0f / float(count);
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        const float *first = values + c;
        for (int64_t block = 0; block < call.statistics; block++) {
            const Floats<W> gradient = read<W>(gradients[block] + c);
            const int64_t kind = call.statistic[block];
            Floats<W> mean = {}, best;
            Masks<W> taker = {};
            if (kind == VARIANCE) mean = mean_of<W>(first, count, channels);
            if (kind == MAX) taker = best_of<W>(first, count, channels, best);
            for (int64_t v = 0; v < count; v++) {
                Floats<W> part = gradient * share;
                if (kind == VARIANCE) {
                    const Floats<W> apart = read<W>(first + v * channels) - mean;
                    part = held_lanes<W>(apart, LARGEST_ROOT) == apart ? 2.0f * part * apart : Floats<W>{};
                } else if (kind == MAX) {
                    part = taker == int32_t(v) ? gradient : Floats<W>{};
                }
                float *to = out + v * channels + c;
                write<W>(to, block == 0 ? part : part + read<W>(to));
            }
        }
    });
}

// Backward of `reduce`: all sites of one scene, one chunk of the channels.
template <class S>
void reduce_backward(const Plan &plan, int64_t scene, int64_t chunk, Room &room) {
    const Call &call = *plan.call;
    Tile *tiles = static_cast<Tile *>(room.tiles);
    Geometric *geometric = static_cast<Geometric *>(room.geometric);
    int64_t axes[3], to_axes[3];
    axis_strides(call.source_stride, axes);
    axis_strides(call.source_gradient_stride, to_axes);
    const int64_t channel = chunk * call.channels / call.chunks;
    const int64_t channels = (chunk + 1) * call.channels / call.chunks - channel;
    const int64_t appended = chunk + 1 == call.chunks ? plan.channels - call.channels : 0;
    const int64_t width = channels + appended;
    const bool places = call.matrix_gradient || call.z_gradient || call.pixels_gradient;
    const bool only_mean = call.statistics == 1 && call.statistic[0] == MEAN;
    for (int64_t v = 0; v < call.views; v++) {
        clear(call, scene, v, channel, channels);
        geometric[v] = Geometric{};
    }
    for (int64_t number = 0; number < plan.tiles; number++) {
        for (int64_t v = 0; v < call.views; v++) {
            start(plan, tiles[v], scene, v, number);
            locate<2>(call, view_of(plan, tiles[v]), tiles[v]);
        }
        Block blocks[3];
        for (int64_t block = 0; block < call.statistics; block++) {
            // The last chunk's channels and the geometric ones follow one another.
            float *to = room.reduced + block * TILE * width;
            blocks[block] = take(call, tiles[0], block * plan.channels + channel, width, to);
        }
        for (int s = 0; s < int(tiles[0].number); s++) {
            int64_t count;
            if (only_mean && !places && appended == 0) {
                count = 0;
                for (int64_t v = 0; v < call.views; v++)
                    if (tiles[v].visible[s]) room.seen[count++] = v;
                const float share = 1.0f / float(count > 0 ? count : 1);
                const float *gradient = blocks[0].first + s * blocks[0].step;
                for (int64_t seen = 0; seen < count; seen++) {
                    const int64_t v = room.seen[seen];
                    float *to = gradient_of(call, scene, v) + channel;
                    scatter<2>(call, tiles[v], s, to, to_axes, channels, gradient, share);
                }
                continue;
            }
            count = visible_values<S>(plan, tiles, s, channel, channels, appended > 0, room);
            const float *gradients[3];
            for (int64_t block = 0; block < call.statistics; block++)
                gradients[block] = blocks[block].first + s * blocks[block].step;
            unsummarise(call, room.values, count, width, gradients, room.spread);
            for (int64_t v = 0, seen = 0; v < call.views; v++) {
                const bool visible = seen < count && room.seen[seen] == v;
                const float *gradient = visible ? room.spread + seen * width : room.nothing;
                seen += visible;
                if (appended) split(call, tiles[v], s, gradient + (visible ? channels : 0), geometric[v]);
                if (places)
                    for (int axis = 0; axis < 2; axis++) geometric[v].by_index[axis][s] = 0.0f;
                if (!visible) continue;
                if (places) {
                    const S *source = source_of<S>(call, scene, v) + channel;
                    place_gradient<2>(call, tiles[v], s, source, axes, channels, gradient, geometric[v].by_index);
                }
                if (!call.source_gradient) continue;
                float *to = gradient_of(call, scene, v) + channel;
                scatter<2>(call, tiles[v], s, to, to_axes, channels, gradient);
            }
        }
        for (int64_t v = 0; v < call.views; v++) finish(plan, tiles[v], chunk, geometric[v]);
    }
}

// One task of a call, by its number.
template <class S>
void task(const Plan &plan, int64_t number, Room &room) {
    const Call &call = *plan.call;
    if (!plan.backward) {
        const int64_t block = number % plan.blocks, rest = number / plan.blocks;
        const int64_t first = block * plan.tiles / plan.blocks, last = (block + 1) * plan.tiles / plan.blocks;
        if (call.statistics) reduce<S>(plan, rest, first, last, room);
        else if (call.kind == VOLUMES) sample<3, S>(plan, rest / call.views, rest % call.views, first, last, room);
        else sample<2, S>(plan, rest / call.views, rest % call.views, first, last, room);
        return;
    }
    const int64_t chunk = number % call.chunks, rest = number / call.chunks;
    if (call.statistics) {
        reduce_backward<S>(plan, rest, chunk, room);
    } else if (call.kind == VOLUMES) {  // the views of a scene share its volume
        const int64_t channel = chunk * call.channels / call.chunks;
        clear(call, rest, 0, channel, (chunk + 1) * call.channels / call.chunks - channel);
        for (int64_t v = 0; v < call.views; v++) sample_backward<3, S>(plan, rest, v, chunk, room);
    } else {
        sample_backward<2, S>(plan, rest / call.views, rest % call.views, chunk, room);
    }
}

inline void run_task(const Plan &plan, int64_t number, Room &room) {
    if (plan.call->source_type == FLOAT32) task<float>(plan, number, room);
    else if (plan.call->source_type == BFLOAT16) task<Bfloat16>(plan, number, room);
    else task<Float16>(plan, number, room);
}

inline Needs needs() { return {sizeof(Tile), sizeof(Geometric), TILE}; }
