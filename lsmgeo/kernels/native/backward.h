// The transposes of what forward.h does, with the gradients by place. Included by resample.h.

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
    double by_z[TILE] = {};  // by z, at each site; depths and slopes may be far apart
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
                const double by_height = by_distance[s] / unit;
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
                by_z[s] -= double(by_plane) * tile.plane[row][s] * tile.depth[s];
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
            for (int s = 0; s < n; s++) by_z[s] -= double(by_distance[s]) * tile.depth[s] * tile.depth[s];
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
                by_z[s] += rows[row][s] * inner;
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

// The parts of the incoming gradient that belong to geometric channels, site by site: 0 where they saturate.
struct Geometric {
    float by_index[3][TILE], by_distance[TILE], by_direction[3][TILE];
};

inline void split(const Call &call, const Tile &tile, int s, const float *gradient, Geometric &geometric) {
    const float limit = call.statistics ? LARGEST : saturation_limit(call.gradient_type);
    if (call.depth) {
        const float distance = std::fabs(tile.distance[s]);
        geometric.by_distance[s] = distance < LARGEST && distance <= limit ? *gradient : 0.0f;
        gradient++;
    }
    if (call.direction)
        for (int row = 0; row < 3; row++) geometric.by_direction[row][s] = *gradient++;
    if (call.extra && call.extras_gradient) {
        const int64_t site = (tile.scene * call.views + tile.view) * call.sites[0] + tile.i + s;
        for (int64_t at = site * call.extra; at < (site + 1) * call.extra; at++, gradient++)
            call.extras_gradient[at] = std::fabs(call.extras[at]) <= limit ? *gradient : 0.0f;
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

// Backward of `sample`: all sites of one view, one chunk of the channels. The last has the geometric channels too.
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
    const float share = 1.0f / float(count), limit = saturation_limit(call.gradient_type);
    // No statistic is above the limit where no value is above its root.
    int32_t is_large = 0;
    if (limit < LARGEST) {
        const float root = std::sqrt(limit);
        for (int64_t at = 0; at < count * channels; at++) is_large |= int32_t(!(std::fabs(values[at]) <= root));
    }
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        const float *first = values + c;
        for (int64_t block = 0; block < call.statistics; block++) {
            Floats<W> gradient = read<W>(gradients[block] + c), mean = {}, best, total = {};
            const int64_t kind = call.statistic[block];
            Masks<W> taker = {}, held = {};
            if (kind == MAX) taker = best_of<W>(first, count, channels, best);
            if (kind == VARIANCE || (kind == MEAN && is_large)) mean = mean_of<W>(first, count, channels);
            if (is_large) {
                const Floats<W> result =
                    kind == MAX ? best : kind == MEAN ? mean : variance_of<W>(first, count, channels, mean);
                gradient = held_lanes<W>(result, limit) == result ? gradient : Floats<W>{};
            }
            for (int64_t v = 0; v < count; v++) {
                Floats<W> part = gradient * share;
                if (kind == VARIANCE) {
                    const Floats<W> apart = read<W>(first + v * channels) - mean;
                    const Masks<W> is_held = held_lanes<W>(apart, LARGEST_ROOT) != apart;
                    part = is_held ? Floats<W>{} : 2.0f * part * apart;
                    total += part;
                    held |= is_held;
                } else if (kind == MAX) {
                    part = taker == int32_t(v) ? gradient : Floats<W>{};
                }
                float *to = out + v * channels + c;
                write<W>(to, block == 0 ? part : part + read<W>(to));
            }
            if (!is_any<W>(held)) continue;
            // Through the mean: 0 but for rounding, unless deviations are held.
            const Floats<W> drift = held ? total * share : Floats<W>{};
            for (int64_t v = 0; v < count; v++) write<W>(out + v * channels + c, read<W>(out + v * channels + c) - drift);
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
                if (!call.source_gradient) continue;
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
