// Values of views and their statistics, tile by tile. Included by resample.h.

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
        for (int64_t s = 0; s < sites; s++) convert_row(block + s * channels, channels, first + s * at.site);
        return;
    }
    for (int64_t c = 0; c < channels; c += LANES) {
        float rows[LANES][TILE];
        const int64_t count = std::min<int64_t>(LANES, channels - c);
        transpose(block + c, channels, rows[0], TILE, sites, count);
        for (int64_t r = 0; r < count; r++) {
            S *to = first + (c + r) * at.channel;
            if (at.site == 1) convert_row(rows[r], sites, to);
            else
                for (int64_t s = 0; s < sites; s++) convert_row(rows[r] + s, 1, to + s * at.site);
        }
    }
}

inline void store_tile(const Call &call, const Layout &at, int64_t sites, int64_t channels, const float *block) {
    if (call.values_type == FLOAT32 && at.site == 1)
        transpose(block, channels, static_cast<float *>(call.values) + at.base, at.channel, sites, channels);
    else if (call.values_type == FLOAT32) store_block(static_cast<float *>(call.values), at, sites, channels, block);
    else if (call.values_type == BFLOAT16)
        store_block(static_cast<Bfloat16 *>(call.values), at, sites, channels, block);
    else store_block(static_cast<Float16 *>(call.values), at, sites, channels, block);
}

template <class S>
inline void load_block(const S *values, const Layout &at, int64_t sites, int64_t channels, float *block) {
    const S *first = values + at.base;
    if (at.channel == 1) {
        for (int64_t s = 0; s < sites; s++) convert_row(first + s * at.site, channels, block + s * channels);
        return;
    }
    for (int64_t c = 0; c < channels; c += LANES) {
        float rows[LANES][TILE];
        const int64_t count = std::min<int64_t>(LANES, channels - c);
        for (int64_t r = 0; r < count; r++) {
            const S *from = first + (c + r) * at.channel;
            if (at.site == 1) convert_row(from, sites, rows[r]);
            else
                for (int64_t s = 0; s < sites; s++) rows[r][s] = to_float(from[s * at.site]);
        }
        transpose(rows[0], TILE, block + c, channels, count, sites);
    }
}

// Channels at the sites of a tile: (sites, channels), `step` floats from site to site; not copied where possible.
struct Block { const float *first; int64_t step; };

inline Block load_channels(const void *array, int64_t type, const Layout &at, int64_t sites, int64_t channels,
                           float *buffer) {
    if (type == FLOAT32) {
        const float *values = static_cast<const float *>(array);
        if (at.channel == 1) return {values + at.base, at.site};
        if (at.site == 1) transpose(values + at.base, at.channel, buffer, channels, channels, sites);
        else load_block(values, at, sites, channels, buffer);
    } else if (type == BFLOAT16) {
        load_block(static_cast<const Bfloat16 *>(array), at, sites, channels, buffer);
    } else {
        load_block(static_cast<const Float16 *>(array), at, sites, channels, buffer);
    }
    return {buffer, channels};
}

// A block of the incoming gradient.
inline Block load_gradient(const Call &call, const Tile &tile, int64_t channel, int64_t channels, float *buffer) {
    Layout at = layout(call.gradient_stride, tile);
    at.base += channel * at.channel;
    return load_channels(call.gradient, call.gradient_type, at, tile.count, channels, buffer);
}

inline Block load_reference(const Call &call, const Tile &tile, int64_t channel, int64_t channels, float *buffer) {
    const int64_t *stride = call.reference_stride;
    Layout at = layout(stride, tile);
    at.base += channel * at.channel;
    return load_channels(call.reference, call.source_type, at, tile.count, channels, buffer);
}

inline void store_visible(const Call &call, const Tile &tile) {
    const int64_t *size = call.sites;
    const int64_t row = ((tile.scene * call.views + tile.view) * size[2] + tile.k) * size[1] + tile.j;
    uint8_t *visible = call.visible + row * size[0] + tile.i;
    const int n = int(tile.count);
    if (tile.along_z)
        for (int s = 0; s < n; s++) visible[s * size[0] * size[1]] = uint8_t(tile.visible[s]);
    else
        for (int s = 0; s < n; s++) visible[s] = uint8_t(tile.visible[s]);
}

// The geometric channels: depth, direction, extras.
inline void append_extra(const Call &call, const Tile &tile, int s, float *out) {
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

inline void start_tile(const Plan &plan, Tile &tile, int64_t scene, int64_t view, int64_t number) {
    const Call &call = *plan.call;
    const int64_t row = number / plan.tiles_per_row, part = number % plan.tiles_per_row;
    const int64_t length = plan.along_z ? call.sites[2] : call.sites[0];
    const int64_t first = part * length / plan.tiles_per_row, last = (part + 1) * length / plan.tiles_per_row;
    tile.scene = scene;
    tile.view = view;
    tile.count = last - first;
    tile.along_z = plan.along_z;
    tile.k = plan.along_z ? first : row / call.sites[1];
    tile.j = plan.along_z ? row / call.sites[0] : row % call.sites[1];
    tile.i = plan.along_z ? row % call.sites[0] : first;
    if (call.depths) load_depths(plan, tile);
}

// Whether a tile of a sweep reads nothing, judged by its two ends: indices are monotonic along a tile. Much of a sweep
// lies outside the volume. A wrong "no" costs only time; the margin exceeds rounding errors.
inline bool misses_volume(const Call &call, const View &view, const Tile &tile) {
    if (call.kind != PLANE_SWEEP_PROJECT) return false;
    if (view.masked) return true;
    if (call.border) return false;
    const int64_t last = tile.count - 1;
    float range[2] = {LARGEST, 0.0f};  // of depths that differ from site to site
    if (call.depths)
        for (int s = 0; s <= int(last); s++) {
            range[0] = std::min(range[0], tile.depth[s]);
            range[1] = std::max(range[1], tile.depth[s]);
        }
    // The index is linear in x and in the depth: its extremes are at the corners.
    const int corners = call.depths ? 4 : 2;
    double least[3], most[3];
    for (int corner = 0; corner < corners; corner++) {
        const int end = corner & 1;
        const double x = call.x[tile.i + (tile.along_z ? 0 : end * last)], y = call.y[tile.j];
        const double depth =
            call.depths ? range[corner >> 1] : 1.0 / plane_z(call, tile, tile.k + (tile.along_z ? end * last : 0));
        for (int row = 0; row < 3; row++) {
            const double *m = view.matrix[row];
            const double index = (m[0] * x + m[1] * y + m[3]) * depth + m[2];
            least[row] = corner ? std::min(least[row], index) : index;
            most[row] = corner ? std::max(most[row], index) : index;
        }
    }
    for (int axis = 0; axis < 3; axis++)
        if (most[axis] < -1.01 || least[axis] > double(call.size[axis]) + 0.01) return true;
    return false;
}

// Zeros for a tile that reads nothing.
inline void store_zeros(const Call &call, Tile &tile, const Layout &at, int64_t channels) {
    for (int64_t s = 0; s < tile.count; s++) tile.visible[s] = 0;
    store_visible(call, tile);
    float *out = static_cast<float *>(call.values) + at.base;
    if (at.channel == 1 && at.site == channels) {
        std::memset(out, 0, size_t(tile.count * channels) * sizeof(float));
    } else if (at.site == 1) {
        for (int64_t c = 0; c < channels; c++)
            std::memset(out + c * at.channel, 0, size_t(tile.count) * sizeof(float));
    } else {
        for (int64_t s = 0; s < tile.count; s++)
            for (int64_t c = 0; c < channels; c++) out[s * at.site + c * at.channel] = 0.0f;
    }
}

// Means, or sums, over groups of channels of reference times sample, one for each group. Products saturate.
inline void correlate(const Call &call, const float *sampled, const float *reference, float *out) {
    const int64_t size = call.channels / call.groups;
    const float share = float(call.share);
    for (int64_t group = 0; group < call.groups; group++) {
        const float *a = sampled + group * size, *b = reference + group * size;
        Floats<LANES> wide = {};
        float sum = 0.0f;
        over_channels(size, [&](auto width, int64_t c) INLINED {
            constexpr int W = decltype(width)::value;
            const Floats<W> part = clamped_lanes<W>(load<W>(a + c) * load<W>(b + c), LARGEST) * share;
            if constexpr (W == LANES) wide += part;
            else sum += horizontal_sum(part);
        });
        out[group] = clamped(sum + horizontal_sum(wide), LARGEST);
    }
}

// Forward without statistics: tiles first to last of one view.
template <int DIMS, class S>
void sample(const Plan &plan, int64_t scene, int64_t view, int64_t first, int64_t last, Workspace &workspace) {
    const Call &call = *plan.call;
    Tile &tile = *static_cast<Tile *>(workspace.tiles);
    int64_t axes[3];
    axis_strides(call.source_stride, axes);
    const S *source = source_pointer<S>(call, scene, view);
    const int64_t channels = plan.channels;
    const OneChannelImage image = one_channel_image(call, axes);
    // Of an image: without any, the only one may be geometric.
    const bool one_channel = DIMS == 2 && call.channels == 1 && channels == 1 && image.fits && !call.groups;
    for (int64_t number = first; number < last; number++) {
        start_tile(plan, tile, scene, view, number);
        const Layout at = layout(call.values_stride, tile);
        const bool can_skip = channels == plan.features && call.values_type == FLOAT32;
        if (can_skip && misses_volume(call, view_of(plan, tile), tile)) {
            store_zeros(call, tile, at, channels);
            continue;
        }
        locate<DIMS>(call, view_of(plan, tile), tile);
        store_visible(call, tile);
        const bool in_place = call.values_type == FLOAT32 && at.channel == 1;
        float *out = in_place ? static_cast<float *>(call.values) + at.base : workspace.values;
        const int64_t step = in_place ? at.site : channels;
        if (one_channel && step == 1 && gather_one_channel(call, tile, source, image, out)) {
            if (!in_place) store_tile(call, at, tile.count, channels, workspace.values);
            continue;
        }
        if constexpr (!std::is_same<S, float>::value) {
            if (call.values_type == call.source_type && at.channel == 1 && channels == call.channels && !call.groups) {
                for (int s = 0; s < int(tile.count); s++) {
                    S *to = static_cast<S *>(call.values) + at.base + s * at.site;
                    // At the edge a sum is not made in one go.
                    const bool at_once = call.nearest || tile.interior[s] || !tile.in_range[s];
                    if (at_once) gather<DIMS>(call, tile, s, source, axes, channels, to);
                    else gather<DIMS>(call, tile, s, source, axes, channels, workspace.values);
                    if (!at_once) convert_row(workspace.values, channels, to);
                }
                continue;
            }
        }
        Block reference = {};
        if (call.groups) reference = load_reference(call, tile, 0, call.channels, workspace.reference);
        for (int s = 0; s < int(tile.count); s++) {
            float *to = out + s * step;
            if (!call.groups) gather<DIMS>(call, tile, s, source, axes, call.channels, to);
            else if (!(DIMS == 3 ? tile.in_range : tile.front)[s])
                std::memset(to, 0, size_t(plan.features) * sizeof(float));
            else {
                gather<DIMS>(call, tile, s, source, axes, call.channels, workspace.sampled);
                correlate(call, workspace.sampled, reference.first + s * reference.step, to);
            }
            append_extra(call, tile, s, to + plan.features);
        }
        if (!in_place) store_tile(call, at, tile.count, channels, workspace.values);
    }
}

// Statistics of one site

// The values of the views that see site s, one after another in workspace.values; returns their number.
template <class S>
inline int64_t gather_visible(const Plan &plan, const Tile *tiles, int s, int64_t channel, int64_t channels,
                              bool geometry, const float *reference, Workspace &workspace) {
    const Call &call = *plan.call;
    const int64_t features = reference ? plan.features : channels;
    const int64_t step = features + (geometry ? plan.channels - plan.features : 0);
    int64_t axes[3], count = 0;
    axis_strides(call.source_stride, axes);
    for (int64_t v = 0; v < call.views; v++) {
        if (!tiles[v].visible[s]) continue;
        float *out = workspace.values + count * step;
        const S *source = source_pointer<S>(call, tiles[v].scene, v) + channel;
        gather<2>(call, tiles[v], s, source, axes, channels, reference ? workspace.sampled : out);
        if (reference) correlate(call, workspace.sampled, reference, out);
        if (geometry) append_extra(call, tiles[v], s, out + features);
        workspace.visible_views[count++] = v;
    }
    return count;
}

constexpr float LARGEST_ROOT = 0x1.fffffep63f;  // the square root of the largest float

template <int W> INLINE Floats<W> mean_of(const float *values, int64_t count, int64_t step) {
    const float share = 1.0f / float(count);
    Floats<W> mean = {};
    for (int64_t v = 0; v < count; v++) mean += load<W>(values + v * step) * share;
    return mean;
}

template <int W> INLINE Floats<W> variance_of(const float *values, int64_t count, int64_t step, Floats<W> mean) {
    const float share = 1.0f / float(count);
    Floats<W> result = {};
    for (int64_t v = 0; v < count; v++) {
        const Floats<W> deviation = clamped_lanes<W>(load<W>(values + v * step) - mean, LARGEST_ROOT);
        result += deviation * deviation * share;
    }
    return clamped_lanes<W>(result, LARGEST);
}

template <int W> INLINE bool any_lane(Masks<W> lanes) {
    int32_t any = 0;
    for (int lane = 0; lane < W; lane++) any |= lanes[lane];
    return any != 0;
}

// The first view with the largest value, where a NaN is above all, and that value.
template <int W> INLINE Masks<W> max_of(const float *values, int64_t count, int64_t step, Floats<W> &best) {
    best = load<W>(values);
    Masks<W> first = {};
    for (int64_t v = 1; v < count; v++) {
        const Floats<W> value = load<W>(values + v * step);
        const Masks<W> keeps = (value <= best) | (best != best);
        best = keeps ? best : value;
        first = keeps ? first : Masks<W>{} + int32_t(v);
    }
    return first;
}

// Statistics of `count` rows of values, a block of channels for each.
inline void statistics(const Call &call, const float *values, int64_t count, int64_t channels, float *out) {
    if (count == 0) {
        std::memset(out, 0, size_t(call.statistics * channels) * sizeof(float));
        return;
    }
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        const float *first = values + c;
        for (int64_t block = 0; block < call.statistics; block++) {
            Floats<W> result = {};
            if (call.statistic[block] == MAX) {
                max_of<W>(first, count, channels, result);
            } else {
                result = mean_of<W>(first, count, channels);
                if (call.statistic[block] == VARIANCE) result = variance_of<W>(first, count, channels, result);
            }
            store<W>(out + block * channels + c, result);
        }
    });
}

// Forward with statistics over the views: tiles first to last of one scene.
template <class S>
void reduce(const Plan &plan, int64_t scene, int64_t first, int64_t last, Workspace &workspace) {
    const Call &call = *plan.call;
    Tile *tiles = static_cast<Tile *>(workspace.tiles);
    const int64_t channels = plan.channels, total = call.statistics * channels;
    const bool only_mean = call.statistics == 1 && call.statistic[0] == MEAN && channels == plan.features;
    int64_t axes[3];
    axis_strides(call.source_stride, axes);
    for (int64_t number = first; number < last; number++) {
        for (int64_t v = 0; v < call.views; v++) {
            start_tile(plan, tiles[v], scene, v, number);
            locate<2>(call, view_of(plan, tiles[v]), tiles[v]);
            store_visible(call, tiles[v]);
        }
        const Layout at = layout(call.values_stride, tiles[0]);
        const bool in_place = call.values_type == FLOAT32 && at.channel == 1;
        Block references = {};
        if (call.groups) references = load_reference(call, tiles[0], 0, call.channels, workspace.reference);
        for (int s = 0; s < int(tiles[0].count); s++) {
            const float *reference = call.groups ? references.first + s * references.step : nullptr;
            float *out = in_place ? static_cast<float *>(call.values) + at.base + s * at.site
                                  : workspace.reduced + s * total;
            if (only_mean) {
                int64_t count = 0;
                for (int64_t v = 0; v < call.views; v++) count += tiles[v].visible[s];
                float *mean = reference ? workspace.sampled : out;
                bool add = false;
                for (int64_t v = 0; v < call.views; v++) {
                    if (!tiles[v].visible[s]) continue;
                    const S *source = source_pointer<S>(call, scene, v);
                    gather<2>(call, tiles[v], s, source, axes, call.channels, mean, 1.0f / float(count), add);
                    add = true;
                }
                if (!add) std::memset(out, 0, size_t(channels) * sizeof(float));
                else if (reference) correlate(call, mean, reference, out);  // that of the mean is the mean of those
                continue;
            }
            const int64_t count = gather_visible<S>(plan, tiles, s, 0, call.channels, true, reference, workspace);
            statistics(call, workspace.values, count, channels, out);
        }
        if (!in_place) store_tile(call, at, tiles[0].count, total, workspace.reduced);
    }
}
