// Positions of sites in the source, interpolation weights, gather and scatter. Included by resample.h.

// Geometry

struct Tile {
    int64_t scene, view, count;
    int64_t k, j, i;                // of the first site
    bool along_z;                   // whether the others follow in z, else in x
    float x[TILE], depth[TILE];     // of the lattice; depth is 1 / z
    float w[TILE], z[TILE];         // where depths differ from site to site: q = (w x, w y, z, w)
    float index[3][TILE];
    float inverse[TILE];            // images: 1 / (M q)_3 where in front
    float plane[3][TILE];           // volumes: the terms of M q in x, y and 1
    float distance[TILE];           // the depth channel
    float direction[3][TILE], inverse_length[TILE];  // the direction channels, and 1 / their vector's length
    float fraction[3][TILE], slope[3][TILE];
    float weight[8][TILE];          // of the taps, where all of them are inside
    int32_t cell[3][TILE];
    int32_t front[TILE], visible[TILE], in_range[TILE], interior[TILE];
};

inline double plane_z(const Call &call, const Tile &tile, int64_t k) {
    return call.z[tile.scene * call.z_stride[0] + tile.view * call.z_stride[1] + k * call.z_stride[2]];
}

// The depths of the sites, where each has its own; one that is not positive and finite counts as 1. Of homogeneous
// q = (x, y, 1 / depth, 1) the multiple with w = min(depth, 1) is taken: nothing overflows, whatever the depth is.
inline void load_depths(const Plan &plan, Tile &tile) {
    const Call &call = *plan.call;
    const int n = int(tile.count);
    const int64_t *stride = call.depths_stride, step = tile.along_z ? stride[2] : stride[4];
    const int64_t first = tile.scene * stride[0] + tile.view * stride[1] + tile.k * stride[2] + tile.j * stride[3] +
                          tile.i * stride[4];
    if (plan.views[tile.scene * call.views + tile.view].masked) {
        for (int s = 0; s < n; s++) tile.depth[s] = 1.0f;
    } else if (call.depths_type == FLOAT32) {
        const float *depths = static_cast<const float *>(call.depths) + first;
        for (int s = 0; s < n; s++) tile.depth[s] = depths[s * step];
    } else {
        const double *depths = static_cast<const double *>(call.depths) + first;
        for (int s = 0; s < n; s++) {
            const double depth = depths[s * step];
            const bool tiny = depth > 0.0 && depth < SMALLEST, huge = depth > LARGEST && std::isfinite(depth);
            tile.depth[s] = tiny ? SMALLEST : huge ? LARGEST : float(depth);
        }
    }
    for (int s = 0; s < n; s++) {
        tile.depth[s] = tile.depth[s] > 0.0f && tile.depth[s] <= LARGEST ? tile.depth[s] : 1.0f;
        tile.w[s] = tile.depth[s] < 1.0f ? tile.depth[s] : 1.0f;
        tile.z[s] = tile.w[s] / tile.depth[s];
    }
}

// Directions G q / |G q|, and 0 where the vector is no longer than the rounding error of its terms, or its square nearly
// underflows.
inline void ray_directions(const Call &call, const View &view, Tile &tile) {
    const int n = int(tile.count);
    const double y = call.y[tile.j];
    float vector[3][TILE], least[TILE];
    for (int row = 0; row < 3; row++) {
        const double *g = view.direction[row];
        if (call.depths) {
            const float slope = float(g[0]), base = float(g[1] * y + g[3]), inner = float(g[2]);
            for (int s = 0; s < n; s++) vector[row][s] = (slope * tile.x[s] + base) * tile.w[s] + inner * tile.z[s];
        } else if (tile.along_z) {
            const float base = float(g[0] * call.x[tile.i] + g[1] * y + g[3]);
            for (int s = 0; s < n; s++) vector[row][s] = float(g[2] * plane_z(call, tile, tile.k + s)) + base;
        } else {
            const float slope = float(g[0]), base = float(g[1] * y + g[2] * plane_z(call, tile, tile.k) + g[3]);
            for (int s = 0; s < n; s++) vector[row][s] = slope * tile.x[s] + base;
        }
    }
    for (int s = 0; s < n; s++) {
        const double w = call.depths ? tile.w[s] : 1.0;
        const double z = call.depths ? tile.z[s] : plane_z(call, tile, tile.k + (tile.along_z ? s : 0));
        const float error = 4.0f * 0x1p-23f * float(view.terms * w + view.terms_z * std::fabs(z));
        const float shortest = error > SMALLEST_DEPTH ? error : SMALLEST_DEPTH;
        least[s] = shortest * shortest;
    }
    for (int s = 0; s < n; s++) {
        const float squares = vector[0][s] * vector[0][s] + vector[1][s] * vector[1][s] + vector[2][s] * vector[2][s];
        const bool away = squares > least[s] && !view.masked;
        tile.inverse_length[s] = away ? 1.0f / std::sqrt(away ? squares : 1.0f) : 0.0f;
        for (int row = 0; row < 3; row++)
            tile.direction[row][s] = away ? vector[row][s] * tile.inverse_length[s] : 0.0f;
    }
}

inline void project_to_pixels(const Call &call, const View &view, Tile &tile) {
    const int n = int(tile.count);
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

// As `project_to_pixels`, with the depth of each site.
inline void project_depths_to_pixels(const Call &call, const View &view, Tile &tile) {
    const int n = int(tile.count);
    const double y = call.y[tile.j];
    const float scale = float(view.scale), near = float(call.near) * scale;
    float height[TILE], slope[3], base[3], inner[3];
    for (int row = 0; row < 3; row++) {
        const double *m = view.matrix[row];
        slope[row] = float(m[0]);
        base[row] = float(m[1] * y + m[3]);
        inner[row] = float(m[2]);
    }
    for (int s = 0; s < n; s++) {
        const float x = tile.x[s], w = tile.w[s], z = tile.z[s], bound = near * z;
        height[s] = (slope[2] * x + base[2]) * w + inner[2] * z;
        const bool front = height[s] > (bound > SMALLEST_DEPTH ? bound : SMALLEST_DEPTH) && !view.masked;
        const float inverse = 1.0f / (front ? height[s] : 1.0f);
        tile.front[s] = front;
        tile.inverse[s] = front ? inverse : 0.0f;
        tile.index[0][s] = front ? ((slope[0] * x + base[0]) * w + inner[0] * z) * inverse : OUTSIDE;
        tile.index[1][s] = front ? ((slope[1] * x + base[1]) * w + inner[1] * z) * inverse : OUTSIDE;
    }
    if (call.depth)
        for (int s = 0; s < n; s++) {
            const double distance = view.masked ? 0.0 : double(height[s]) / (double(tile.z[s]) * scale);
            tile.distance[s] = float(distance > LARGEST ? LARGEST : distance < -LARGEST ? -LARGEST : distance);
        }
}

inline void load_pixels(const Call &call, Tile &tile) {
    const int64_t first = (tile.scene * call.views + tile.view) * call.sites[0] + tile.i;
    for (int s = 0; s < int(tile.count); s++) {
        const bool front = call.front[first + s] != 0;
        tile.front[s] = front;
        tile.index[0][s] = front ? call.pixels[2 * (first + s)] : OUTSIDE;
        tile.index[1][s] = front ? call.pixels[2 * (first + s) + 1] : OUTSIDE;
    }
}

inline void project_to_voxels(const Call &call, const View &view, Tile &tile) {
    const int n = int(tile.count);
    const double y = call.y[tile.j];
    if (!call.depths)
        for (int s = 0; s < n; s++) {
            const double depth = 1.0 / plane_z(call, tile, tile.k + (tile.along_z ? s : 0));
            tile.depth[s] = float(depth > LARGEST ? LARGEST : depth);
        }
    for (int s = 0; s < n; s++) tile.front[s] = tile.depth[s] > float(call.near) && !view.masked;
    for (int row = 0; row < 3; row++) {
        const double *m = view.matrix[row];
        const float slope = float(m[0]), base = float(m[1] * y + m[3]), offset = float(m[2]);
        for (int s = 0; s < n; s++) {
            const float plane = clamped(slope * tile.x[s] + base, LARGEST_COORDINATE);
            tile.plane[row][s] = plane;
            tile.index[row][s] = tile.front[s] ? plane * tile.depth[s] + offset : OUTSIDE;
        }
    }
    if (call.depth)
        for (int s = 0; s < n; s++) tile.distance[s] = view.masked ? 0.0f : tile.depth[s];
}

// Cells, fractions and weights from indices; which sites are visible, have any tap inside, have all taps inside.
template <int DIMS>
inline void interpolation_weights(const Call &call, Tile &tile) {
    const int n = int(tile.count);
    const bool nearest = call.nearest != 0, border = call.border != 0;
    for (int s = 0; s < n; s++) tile.visible[s] = tile.in_range[s] = tile.interior[s] = tile.front[s];
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
            tile.in_range[s] &= int32_t(cell >= least) & int32_t(cell < size);
            tile.interior[s] &= int32_t(cell >= 0.0f) & int32_t(cell < size - 1.0f);
            tile.slope[axis][s] = !border || (index > 0.0f && index < size - 1.0f) ? 1.0f : 0.0f;
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

// Taps: the cells that a site reads. Almost all sites have 2^DIMS of them inside the source, which is the fast case,
// or one in nearest sampling. At the source's edge each tap is tested.

template <int DIMS>
INLINE int64_t cell_offset(const Tile &tile, int s, const int64_t *stride) {
    int64_t corner = tile.cell[0][s] * stride[0] + tile.cell[1][s] * stride[1];
    if (DIMS == 3) corner += tile.cell[2][s] * stride[2];
    return corner;
}

INLINE int64_t tap_offset(int tap, const int64_t *stride) {
    return (tap & 1 ? stride[0] : 0) + (tap & 2 ? stride[1] : 0) + (tap & 4 ? stride[2] : 0);
}

template <int DIMS>
INLINE bool is_tap_inside(const Call &call, const Tile &tile, int s, int tap) {
    bool inside = true;
    for (int axis = 0; axis < DIMS; axis++) {
        const int32_t cell = tile.cell[axis][s] + (tap >> axis & 1);
        inside = inside && cell >= 0 && cell < call.size[axis];
    }
    return inside;
}

// The weight of a tap, without the factors of the axes in `without` (one bit each).
template <int DIMS>
INLINE float tap_weight(const Tile &tile, int s, int tap, int without = 0) {
    float weight = 1.0f;
    for (int axis = 0; axis < DIMS; axis++)
        if (!(without >> axis & 1)) weight *= tap >> axis & 1 ? tile.fraction[axis][s] : 1.0f - tile.fraction[axis][s];
    return weight;
}

// out (+)= sum of N taps times their weights.
template <int N, class S, class Out>
INLINE void weighted_sum(const S *const *place, const float *weight, int64_t channels, Out *out, bool add) {
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        Floats<W> sum = weight[0] * load<W>(place[0] + c);
        if (add) sum += load<W>(out + c);
        for (int tap = 1; tap < N; tap++) sum += weight[tap] * load<W>(place[tap] + c);
        store<W>(out + c, sum);
    });
}

// The value at site s times a factor, written to `out` or added to it.
template <int DIMS, class S, class Out>
inline void gather(const Call &call, const Tile &tile, int s, const S *source, const int64_t *stride, int64_t channels,
                   Out *out, float factor = 1.0f, bool add = false) {
    constexpr int N = 1 << DIMS;
    if (!tile.in_range[s]) {
        if (!add) std::memset(out, 0, size_t(channels) * sizeof(Out));
        return;
    }
    const S *corner = source + cell_offset<DIMS>(tile, s, stride);
    if (call.nearest) return weighted_sum<1>(&corner, &factor, channels, out, add);
    if (tile.interior[s]) {
        const S *place[N];
        float weight[N];
        for (int tap = 0; tap < N; tap++) {
            place[tap] = corner + tap_offset(tap, stride);
            weight[tap] = tile.weight[tap][s] * factor;
        }
        return weighted_sum<N>(place, weight, channels, out, add);
    }
    for (int tap = 0; tap < N; tap++) {
        if (!is_tap_inside<DIMS>(call, tile, s, tap)) continue;
        const S *place = corner + tap_offset(tap, stride);
        const float weight = tap_weight<DIMS>(tile, s, tap) * factor;
        weighted_sum<1>(&place, &weight, channels, out, add);
        add = true;
    }
}

// An image of one channel; `fits`: its offsets are int32, half as wide in a vector.
struct OneChannelImage { int32_t last_x, last_y, step_x, step_y; bool fits; };

inline OneChannelImage one_channel_image(const Call &call, const int64_t *stride) {
    const int64_t last_x = call.size[0] - 1, last_y = call.size[1] - 1;
    const bool fits = last_x * stride[0] + last_y * stride[1] <= INT32_MAX;
    return {int32_t(last_x), int32_t(last_y), int32_t(stride[0]), int32_t(stride[1]), fits};
}

// The values of one channel at all sites of a tile, in vectors of sites. Returns false, and does nothing, where a site
// interpolates between pixels and zeros outside.
template <class S>
inline bool gather_one_channel(const Call &call, const Tile &tile, const S *source, const OneChannelImage &image,
                               float *out) {
    const int n = int(tile.count), padded = (n + LANES - 1) / LANES * LANES;
    int32_t offsets[4][TILE];
    float values[TILE];
    int32_t interior = 1;
    for (int s = 0; s < n; s++) interior &= tile.interior[s];
    if (!interior && !call.border && !call.nearest) return false;
    for (int s = 0; s < n; s++) {
        const bool in_range = tile.in_range[s] != 0;
        const int32_t x = in_range ? tile.cell[0][s] : 0, y = in_range ? tile.cell[1][s] : 0;
        // A tap beyond the border has no weight and reads the corner, whose NaN counts in any case.
        const int32_t corner = x * image.step_x + y * image.step_y;
        const int32_t right = x < image.last_x ? image.step_x : 0, down = y < image.last_y ? image.step_y : 0;
        offsets[0][s] = corner;
        offsets[1][s] = corner + right;
        offsets[2][s] = corner + down;
        offsets[3][s] = corner + right + down;
    }
    const int taps = call.nearest ? 1 : 4;
    for (int tap = 0; tap < taps; tap++)
        for (int s = n; s < padded; s++) offsets[tap][s] = 0;
    for (int s = 0; s < padded; s += LANES) {
        Floats<LANES> value = gather_lanes(source, offsets[0] + s);
        if (!call.nearest) {
            value *= load<LANES>(tile.weight[0] + s);
            for (int tap = 1; tap < 4; tap++)
                value += load<LANES>(tile.weight[tap] + s) * gather_lanes(source, offsets[tap] + s);
        }
        store<LANES>(values + s, value);
    }
    for (int s = 0; s < n; s++) values[s] = tile.in_range[s] ? values[s] : 0.0f;
    std::memcpy(out, values, size_t(n) * sizeof(float));
    return true;
}

template <int N>
INLINE void scatter_taps(float *const *place, const float *weight, int64_t channels, const float *gradient) {
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        const Floats<W> part = load<W>(gradient + c);
        for (int tap = 0; tap < N; tap++) store<W>(place[tap] + c, load<W>(place[tap] + c) + weight[tap] * part);
    });
}

// The transpose of `gather`: adds the gradient to the value at site s to that of the source.
template <int DIMS>
inline void scatter(const Call &call, const Tile &tile, int s, float *source, const int64_t *stride, int64_t channels,
                    const float *gradient, float factor = 1.0f) {
    constexpr int N = 1 << DIMS;
    if (!tile.in_range[s]) return;
    float *corner = source + cell_offset<DIMS>(tile, s, stride);
    if (call.nearest) return scatter_taps<1>(&corner, &factor, channels, gradient);
    if (tile.interior[s]) {
        float *place[N];
        float weight[N];
        for (int tap = 0; tap < N; tap++) {
            place[tap] = corner + tap_offset(tap, stride);
            weight[tap] = tile.weight[tap][s] * factor;
        }
        return scatter_taps<N>(place, weight, channels, gradient);
    }
    for (int tap = 0; tap < N; tap++) {
        if (!is_tap_inside<DIMS>(call, tile, s, tap)) continue;
        float *place = corner + tap_offset(tap, stride);
        const float weight = tap_weight<DIMS>(tile, s, tap) * factor;
        scatter_taps<1>(&place, &weight, channels, gradient);
    }
}

// The gradient to the index of site s from that to its value: taps times the slopes of their weights, times the
// gradient, summed over the channels.
template <int N, int DIMS, class S>
INLINE void accumulate_index_gradient(const S *const *place, const float (*slope)[DIMS], int64_t channels,
                                      const float *gradient, float *sums) {
    Floats<LANES> wide[DIMS] = {};
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        const Floats<W> grad_value = load<W>(gradient + c);
        Floats<W> grad_index[DIMS] = {};
        for (int tap = 0; tap < N; tap++) {
            const Floats<W> value = load<W>(place[tap] + c);
            for (int axis = 0; axis < DIMS; axis++) grad_index[axis] += slope[tap][axis] * value;
        }
        for (int axis = 0; axis < DIMS; axis++) {
            if constexpr (W == LANES) wide[axis] += grad_index[axis] * grad_value;
            else sums[axis] += horizontal_sum(grad_index[axis] * grad_value);
        }
    });
    for (int axis = 0; axis < DIMS; axis++) sums[axis] += horizontal_sum(wide[axis]);
}

template <int DIMS, class S>
inline void index_gradient(const Call &call, const Tile &tile, int s, const S *source, const int64_t *stride,
                           int64_t channels, const float *gradient, float (*grad_index)[TILE]) {
    constexpr int N = 1 << DIMS;
    float sums[DIMS] = {};
    if (tile.in_range[s] && !call.nearest) {
        const S *corner = source + cell_offset<DIMS>(tile, s, stride), *place[N];
        float slope[N][DIMS];
        for (int tap = 0; tap < N; tap++) {
            place[tap] = corner + tap_offset(tap, stride);
            for (int axis = 0; axis < DIMS; axis++) {
                const float rest = tap_weight<DIMS>(tile, s, tap, 1 << axis) * tile.slope[axis][s];
                slope[tap][axis] = tap >> axis & 1 ? rest : -rest;
            }
        }
        if (tile.interior[s]) {
            accumulate_index_gradient<N, DIMS>(place, slope, channels, gradient, sums);
        } else {
            for (int tap = 0; tap < N; tap++)
                if (is_tap_inside<DIMS>(call, tile, s, tap))
                    accumulate_index_gradient<1, DIMS>(place + tap, slope + tap, channels, gradient, sums);
        }
    }
    for (int axis = 0; axis < DIMS; axis++) grad_index[axis][s] = sums[axis];
}
