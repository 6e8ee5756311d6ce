// Where sites fall, and what they mix there. Included by resample.h.

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
        for (int row = 0; row < 3; row++) tile.direction[row][s] = away ? vector[row][s] * tile.shrink[s] : 0.0f;
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
        const double per_unit = 1.0 / unit;
        for (int s = 0; s < n; s++) {
            const double distance = view.masked ? 0.0 : double(slope[2] * tile.x[s] + base[2]) * per_unit;
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

// Taps: the cells that a site mixes. Almost all sites have 2^DIMS of them inside the source, which is the fast case,
// or, in nearest sampling, one. At the source's edge taps are taken one by one.

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

// An image of one channel whose offsets take half the room in a vector.
struct Plain { int32_t last_x, last_y, step_x, step_y; bool fits; };

inline Plain plain(const Call &call, const int64_t *stride) {
    const int64_t last_x = call.size[0] - 1, last_y = call.size[1] - 1;
    const bool fits = last_x * stride[0] + last_y * stride[1] <= INT32_MAX;
    return {int32_t(last_x), int32_t(last_y), int32_t(stride[0]), int32_t(stride[1]), fits};
}

// The values of one channel at all sites of a tile: vectors of sites, where channels make none. It declines, and does
// nothing, where a site mixes pixels with what lies outside.
template <class S>
inline bool gather_row(const Call &call, const Tile &tile, const S *source, const Plain &image, float *out) {
    const int n = int(tile.number), padded = (n + LANES - 1) / LANES * LANES;
    int32_t places[4][TILE];
    float values[TILE];
    int32_t whole = 1;
    for (int s = 0; s < n; s++) whole &= tile.whole[s];
    if (!whole && !call.border && !call.nearest) return false;
    for (int s = 0; s < n; s++) {
        const bool reads = tile.reads[s] != 0;
        const int32_t x = reads ? tile.cell[0][s] : 0, y = reads ? tile.cell[1][s] : 0;
        // A tap beyond the border has no weight and looks at the corner, where a NaN counts in any case.
        const int32_t corner = x * image.step_x + y * image.step_y;
        const int32_t right = x < image.last_x ? image.step_x : 0, down = y < image.last_y ? image.step_y : 0;
        places[0][s] = corner;
        places[1][s] = corner + right;
        places[2][s] = corner + down;
        places[3][s] = corner + right + down;
    }
    const int taps = call.nearest ? 1 : 4;
    for (int tap = 0; tap < taps; tap++)
        for (int s = n; s < padded; s++) places[tap][s] = 0;
    for (int s = 0; s < padded; s += LANES) {
        Floats<LANES> value = read_at(source, places[0] + s);
        if (!call.nearest) {
            value *= read<LANES>(tile.weight[0] + s);
            for (int tap = 1; tap < 4; tap++)
                value += read<LANES>(tile.weight[tap] + s) * read_at(source, places[tap] + s);
        }
        write<LANES>(values + s, value);
    }
    for (int s = 0; s < n; s++) values[s] = tile.reads[s] ? values[s] : 0.0f;
    std::memcpy(out, values, size_t(n) * sizeof(float));
    return true;
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
INLINE void agree(const S *const *place, const float (*slope)[DIMS], int64_t channels, const float *gradient,
                  float *sums) {
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
