// The transposes of forward.h, and the gradients to the geometry. Included by resample.h.

// Gradients to the index and to the geometric channels of each site, 0 where these saturate.
struct SiteGradients {
    float grad_index[3][TILE], grad_distance[TILE], grad_direction[3][TILE];
};

// Images, index (M q) / (M q)_3: adds to the gradient to M, unless null, and returns that to z, or adds that to the
// depth of each site to `grad_depth`.
inline double accumulate_image_gradients(const Call &call, const View &view, const Tile &tile,
                                         const SiteGradients &site, double *matrix, double *grad_depth) {
    const int n = int(tile.count);
    const bool per_site = call.depths != nullptr;
    const double y = call.y[tile.j], z = per_site ? 1.0 : plane_z(call, tile, tile.k);
    const double unit = (call.projective ? z : 1.0) * view.scale;
    double grad_z = 0.0;
    float rows[3][TILE];
    for (int s = 0; s < n; s++) {
        rows[0][s] = site.grad_index[0][s] * tile.inverse[s];
        rows[1][s] = site.grad_index[1][s] * tile.inverse[s];
        rows[2][s] = 0.0f;
    }
    for (int s = 0; s < n; s++)
        if (rows[0][s] != 0.0f || rows[1][s] != 0.0f)
            rows[2][s] = -(rows[0][s] * tile.index[0][s] + rows[1][s] * tile.index[1][s]);
    if (call.depth && !view.masked)
        for (int s = 0; s < n; s++) {
            const double grad_height = site.grad_distance[s] / (per_site ? unit * tile.z[s] : unit);
            rows[2][s] += float(grad_height);
            if (per_site) grad_depth[s] += double(site.grad_distance[s]) * tile.distance[s] / tile.depth[s];
            else if (call.projective) grad_z -= grad_height * double(tile.distance[s]) * view.scale;
        }
    for (int row = 0; row < 3; row++) {
        float sum = 0.0f, sum_x = 0.0f, sum_z = 0.0f;
        if (per_site) {
            for (int s = 0; s < n; s++) {
                const float scaled = rows[row][s] * tile.w[s];
                sum += scaled;
                sum_x += scaled * tile.x[s];
                sum_z += rows[row][s] * tile.z[s];
                // A multiple of q is the same site: as if only z = 1 / depth followed from the depth.
                grad_depth[s] -= double(rows[row][s]) * view.matrix[row][2] * tile.z[s] / tile.depth[s];
            }
        } else {
            for (int s = 0; s < n; s++) {
                sum += rows[row][s];
                sum_x += rows[row][s] * tile.x[s];
            }
        }
        if (matrix) {
            double *to = matrix + 4 * row;
            to[0] += view.scale * double(sum_x);
            to[1] += view.scale * double(sum) * y;
            to[2] += view.scale * (per_site ? double(sum_z) : double(sum) * z);
            to[3] += view.scale * double(sum);
        }
        grad_z += view.matrix[row][2] * double(sum);
    }
    return grad_z;
}

// Volumes, index (M q) / s: adds to the gradient to M, unless null, and to that to the z, or own depth, of each site.
inline void accumulate_volume_gradients(const Call &call, const View &view, const Tile &tile,
                                        const SiteGradients &site, double *matrix, double *grad_z) {
    const int n = int(tile.count);
    const bool per_site = call.depths != nullptr;
    const double y = call.y[tile.j];
    for (int row = 0; row < 3; row++) {
        float sum = 0.0f, sum_x = 0.0f, sum_offset = 0.0f;
        for (int s = 0; s < n; s++) {
            const float grad_plane = site.grad_index[row][s] * tile.depth[s];
            const float unclamped = std::fabs(tile.plane[row][s]) < LARGEST_COORDINATE ? grad_plane : 0.0f;
            sum += unclamped;
            sum_x += unclamped * tile.x[s];
            sum_offset += site.grad_index[row][s];
            const double grad_depth = double(site.grad_index[row][s]) * tile.plane[row][s];
            grad_z[s] += per_site ? grad_depth : -grad_depth * tile.depth[s] * tile.depth[s];
        }
        if (matrix) {
            double *to = matrix + 4 * row;
            to[0] += sum_x;
            to[1] += double(sum) * y;
            to[2] += sum_offset;
            to[3] += sum;
        }
    }
    if (call.depth && !view.masked)
        for (int s = 0; s < n; s++)
            grad_z[s] += site.grad_distance[s] * (per_site ? 1.0 : -double(tile.depth[s]) * tile.depth[s]);
}

// Ray directions: adds to the gradient to G, unless null, and to that to the z, or own depth, of each site.
inline void accumulate_direction_gradients(const Call &call, const View &view, const Tile &tile,
                                           const SiteGradients &site, double *direction, double *grad_z) {
    const int n = int(tile.count);
    const bool per_site = call.depths != nullptr;
    const double y = call.y[tile.j];
    float rows[3][TILE];
    for (int s = 0; s < n; s++) {
        float along = 0.0f;
        for (int row = 0; row < 3; row++) along += site.grad_direction[row][s] * tile.direction[row][s];
        for (int row = 0; row < 3; row++)
            rows[row][s] = (site.grad_direction[row][s] - along * tile.direction[row][s]) * tile.inverse_length[s];
    }
    for (int row = 0; row < 3; row++) {
        const double inner = view.direction[row][2];
        double sum = 0.0, sum_x = 0.0, sum_z = 0.0;
        for (int s = 0; s < n; s++) {
            const double along = rows[row][s], scaled = per_site ? along * tile.w[s] : along;
            sum += scaled;
            sum_x += scaled * tile.x[s];
            sum_z += along * (per_site ? tile.z[s] : plane_z(call, tile, tile.k + (tile.along_z ? s : 0)));
            grad_z[s] += per_site ? -along * inner * tile.z[s] / tile.depth[s] : along * inner;
        }
        if (direction) {
            double *to = direction + 4 * row;
            to[0] += view.direction_scale * sum_x;
            to[1] += view.direction_scale * sum * y;
            to[2] += view.direction_scale * sum_z;
            to[3] += view.direction_scale * sum;
        }
    }
}

inline void load_extra_gradients(const Call &call, const Tile &tile, int s, const float *gradient,
                                 SiteGradients &site_gradients) {
    const float limit = call.statistics ? LARGEST : saturation_limit(call.gradient_type);
    if (call.depth) {
        const float distance = std::fabs(tile.distance[s]);
        site_gradients.grad_distance[s] = distance < LARGEST && distance <= limit ? *gradient : 0.0f;
        gradient++;
    }
    if (call.direction)
        for (int row = 0; row < 3; row++) site_gradients.grad_direction[row][s] = *gradient++;
    if (call.extra && call.extras_gradient) {
        const int64_t site = (tile.scene * call.views + tile.view) * call.sites[0] + tile.i + s;
        for (int64_t at = site * call.extra; at < (site + 1) * call.extra; at++, gradient++)
            call.extras_gradient[at] = std::fabs(call.extras[at]) <= limit ? *gradient : 0.0f;
    }
}

// Adds the gradients to a view's matrices M and G and to z, or writes those to its pixels.
inline void store_geometry_gradients(const Plan &plan, const Tile &tile, int64_t chunk, const SiteGradients &site) {
    const Call &call = *plan.call;
    const View &view = view_of(plan, tile);
    if (call.kind != SAMPLE_VIEWS) {
        const int64_t at = (tile.scene * call.views + tile.view) * call.chunks + chunk;
        double *matrix = call.matrix_gradient ? call.matrix_gradient + 12 * at : nullptr;
        double *direction = call.direction_gradient ? call.direction_gradient + 12 * at : nullptr;
        double *z = call.z_gradient ? call.z_gradient + call.sites[2] * at : nullptr;
        if (!matrix && !direction && !z && !call.depths_gradient) return;
        double grad_z[TILE] = {}, tile_grad_z = 0.0;
        if (call.kind == PLANE_SWEEP_PROJECT) accumulate_volume_gradients(call, view, tile, site, matrix, grad_z);
        else tile_grad_z = accumulate_image_gradients(call, view, tile, site, matrix, grad_z);
        if (call.direction && !view.masked)
            accumulate_direction_gradients(call, view, tile, site, direction, grad_z);
        if (call.depths_gradient) {
            const int64_t *stride = call.depths_gradient_stride, *size = call.sites;
            float *depths = call.depths_gradient + chunk * stride[0] + tile.scene * stride[1] + tile.view * stride[2] +
                            (tile.k * size[1] + tile.j) * size[0] + tile.i;
            const int64_t step = tile.along_z ? size[0] * size[1] : 1;
            for (int s = 0; s < int(tile.count); s++) depths[s * step] += float(grad_z[s]);
        }
        if (!z) return;
        z[tile.k] += tile_grad_z;
        for (int s = 0; s < int(tile.count); s++) z[tile.k + (tile.along_z ? s : 0)] += grad_z[s];
    } else if (call.pixels_gradient) {
        const int64_t at = ((chunk * call.scenes + tile.scene) * call.views + tile.view) * call.sites[0] + tile.i;
        for (int64_t s = 0; s < tile.count; s++)
            for (int axis = 0; axis < 2; axis++) call.pixels_gradient[2 * (at + s) + axis] = site.grad_index[axis][s];
    }
}

// Transpose of `correlate` for channels `channel` to `channel + channels`: out (+)= the gradient to each channel's group
// times the other factor.
inline void correlate_backward(const Call &call, const float *gradient, const float *other, int64_t channel,
                               int64_t channels, float *out, bool add) {
    const int64_t size = call.channels / call.groups;
    for (int64_t c = 0; c < channels;) {
        const int64_t group = (channel + c) / size, end = std::min(channels, (group + 1) * size - channel);
        const float factor = gradient[group] * float(call.share);
        if (add)
            for (; c < end; c++) out[c] += factor * other[c];
        else
            for (; c < end; c++) out[c] = factor * other[c];
    }
}

inline float *reference_gradient(const Call &call, const Tile &tile, int s, int64_t channel) {
    const int64_t *stride = call.reference_gradient_stride;
    const int64_t k = tile.k + (tile.along_z ? s : 0), i = tile.i + (tile.along_z ? 0 : s);
    return call.reference_gradient + tile.scene * stride[0] + tile.view * stride[1] + k * stride[2] + tile.j * stride[3] +
           i * stride[4] + channel;
}

inline bool needs_index_gradient(const Call &call) {
    return call.matrix_gradient || call.z_gradient || call.depths_gradient || call.pixels_gradient;
}

// Backward of `sample`: all sites of one view, one chunk of the channels. The last also has the geometric channels.
template <int DIMS, class S>
void sample_backward(const Plan &plan, int64_t view, int64_t chunk, const Sums &sums, Workspace &workspace) {
    const Call &call = *plan.call;
    Tile &tile = *static_cast<Tile *>(workspace.tiles);
    int64_t axes[3];
    axis_strides(call.source_stride, axes);
    const int64_t scene = sums.scene, channel = sums.channel, channels = sums.channels;
    const int64_t appended = plan.channels - plan.features;
    const bool has_extra = chunk + 1 == call.chunks && appended > 0;
    const bool needs_index = needs_index_gradient(call);
    // Where correlations may saturate, and then have no gradient, they are computed again.
    const bool can_saturate = call.groups && call.gradient_type != FLOAT32;
    const S *source = source_pointer<S>(call, scene, view) + channel;
    SiteGradients site_gradients = {};
    for (int64_t number = 0; number < plan.tiles; number++) {
        start_tile(plan, tile, scene, view, number);
        if (appended == 0 && misses_volume(call, view_of(plan, tile), tile)) continue;
        locate<DIMS>(call, view_of(plan, tile), tile);
        Block block, reference = {};
        if (call.groups) {
            block = load_gradient(call, tile, 0, plan.features, workspace.values);
            reference = load_reference(call, tile, 0, call.channels, workspace.reference);
        } else {
            block = load_gradient(call, tile, channel, channels, workspace.values);
        }
        for (int s = 0; s < int(tile.count); s++) {
            const float *gradient = block.first + s * block.step;
            if (call.groups) {
                if (!tile.in_range[s]) {
                    for (int axis = 0; axis < DIMS; axis++) site_gradients.grad_index[axis][s] = 0.0f;
                    continue;
                }
                const float *factor = reference.first + s * reference.step;
                if (can_saturate) {
                    const S *all = source_pointer<S>(call, scene, view);
                    gather<DIMS>(call, tile, s, all, axes, call.channels, workspace.sampled);
                    correlate(call, workspace.sampled, factor, workspace.value_gradients);
                    const float limit = saturation_limit(call.gradient_type);
                    for (int64_t group = 0; group < call.groups; group++)
                        workspace.value_gradients[group] =
                            std::fabs(workspace.value_gradients[group]) <= limit ? gradient[group] : 0.0f;
                    gradient = workspace.value_gradients;
                }
                if (call.reference_gradient) {
                    gather<DIMS>(call, tile, s, source, axes, channels, workspace.sampled);
                    correlate_backward(call, gradient, workspace.sampled, channel, channels,
                                       reference_gradient(call, tile, s, channel), true);
                }
                if (call.groups == 1 && !needs_index) {
                    if (sums.first)
                        scatter<DIMS>(call, tile, s, sums.first, sums.axes, channels, factor + channel,
                                      gradient[0] * float(call.share));
                    continue;
                }
                correlate_backward(call, gradient, factor + channel, channel, channels, workspace.row, false);
                gradient = workspace.row;
            }
            if (needs_index)
                index_gradient<DIMS>(call, tile, s, source, axes, channels, gradient, site_gradients.grad_index);
            if (sums.first) scatter<DIMS>(call, tile, s, sums.first, sums.axes, channels, gradient);
        }
        if (has_extra) {
            const Block last = load_gradient(call, tile, plan.features, appended, workspace.values);
            for (int s = 0; s < int(tile.count); s++)
                load_extra_gradients(call, tile, s, last.first + s * last.step, site_gradients);
        }
        store_geometry_gradients(plan, tile, chunk, site_gradients);
    }
}

// From the gradients to the statistics of one site to those to the values of each view that sees it.
inline void statistics_backward(const Call &call, const float *values, int64_t count, int64_t channels,
                        const float *const *gradients, float *out) {
    if (count == 0) return;
    const float share = 1.0f / float(count), limit = saturation_limit(call.gradient_type);
    // No statistic exceeds the limit where no value exceeds its root.
    int32_t is_large = 0;
    if (limit < LARGEST) {
        const float root = std::sqrt(limit);
        for (int64_t at = 0; at < count * channels; at++) is_large |= int32_t(!(std::fabs(values[at]) <= root));
    }
    over_channels(channels, [&](auto width, int64_t c) INLINED {
        constexpr int W = decltype(width)::value;
        const float *first = values + c;
        for (int64_t block = 0; block < call.statistics; block++) {
            Floats<W> gradient = load<W>(gradients[block] + c), mean = {}, best, total = {};
            const int64_t kind = call.statistic[block];
            Masks<W> argmax = {}, any_clamped = {};
            if (kind == MAX) argmax = max_of<W>(first, count, channels, best);
            if (kind == VARIANCE || (kind == MEAN && is_large)) mean = mean_of<W>(first, count, channels);
            if (is_large) {
                const Floats<W> result =
                    kind == MAX ? best : kind == MEAN ? mean : variance_of<W>(first, count, channels, mean);
                gradient = clamped_lanes<W>(result, limit) == result ? gradient : Floats<W>{};
            }
            for (int64_t v = 0; v < count; v++) {
                Floats<W> part = gradient * share;
                if (kind == VARIANCE) {
                    const Floats<W> deviation = load<W>(first + v * channels) - mean;
                    const Masks<W> is_clamped = clamped_lanes<W>(deviation, LARGEST_ROOT) != deviation;
                    part = is_clamped ? Floats<W>{} : 2.0f * part * deviation;
                    total += part;
                    any_clamped |= is_clamped;
                } else if (kind == MAX) {
                    part = argmax == int32_t(v) ? gradient : Floats<W>{};
                }
                float *to = out + v * channels + c;
                store<W>(to, block == 0 ? part : part + load<W>(to));
            }
            if (!any_lane<W>(any_clamped)) continue;
            // Through the mean: 0 but for rounding, unless deviations are clamped.
            const Floats<W> drift = any_clamped ? total * share : Floats<W>{};
            for (int64_t v = 0; v < count; v++) {
                float *to = out + v * channels + c;
                store<W>(to, load<W>(to) - drift);
            }
        }
    });
}

// Backward of `reduce`: all sites of one scene, one chunk of the channels.
template <class S>
void reduce_backward(const Plan &plan, int64_t chunk, const Sums &sums, Workspace &workspace) {
    const Call &call = *plan.call;
    Tile *tiles = static_cast<Tile *>(workspace.tiles);
    SiteGradients *site_gradients = static_cast<SiteGradients *>(workspace.site_gradients);
    int64_t axes[3];
    axis_strides(call.source_stride, axes);
    const int64_t scene = sums.scene, channel = sums.channel, channels = sums.channels;
    const int64_t appended = chunk + 1 == call.chunks ? plan.channels - plan.features : 0;
    // Of the values: those of this chunk, or all correlations.
    const int64_t features = call.groups ? plan.features : channels, width = features + appended;
    const bool needs_index = needs_index_gradient(call);
    const bool only_mean = call.statistics == 1 && call.statistic[0] == MEAN;
    const bool is_linear = only_mean && appended == 0 && (!call.groups || call.gradient_type == FLOAT32);
    for (int64_t v = 0; v < call.views; v++) site_gradients[v] = SiteGradients{};
    for (int64_t number = 0; number < plan.tiles; number++) {
        for (int64_t v = 0; v < call.views; v++) {
            start_tile(plan, tiles[v], scene, v, number);
            locate<2>(call, view_of(plan, tiles[v]), tiles[v]);
        }
        Block blocks[3];
        for (int64_t block = 0; block < call.statistics; block++) {
            // The geometric channels follow those of the last chunk.
            float *to = workspace.reduced + block * TILE * width;
            const int64_t first = block * plan.channels + (call.groups ? 0 : channel);
            blocks[block] = load_gradient(call, tiles[0], first, width, to);
        }
        Block references = {};
        if (call.groups) references = load_reference(call, tiles[0], 0, call.channels, workspace.reference);
        for (int s = 0; s < int(tiles[0].count); s++) {
            const float *reference = call.groups ? references.first + s * references.step : nullptr;
            float *to_reference =
                call.reference_gradient ? reference_gradient(call, tiles[0], s, channel) : nullptr;
            int64_t count;
            if (is_linear && (reference || !needs_index)) {
                count = 0;
                for (int64_t v = 0; v < call.views; v++)
                    if (tiles[v].visible[s]) workspace.visible_views[count++] = v;
                if (needs_index)
                    for (int64_t v = 0; v < call.views; v++)
                        for (int axis = 0; axis < 2; axis++) site_gradients[v].grad_index[axis][s] = 0.0f;
                if (count == 0) continue;
                float share = 1.0f / float(count);
                const float *gradient = blocks[0].first + s * blocks[0].step;
                if (reference) {
                    for (int64_t group = 0; group < features; group++)
                        workspace.value_gradients[group] = gradient[group] * share;
                    correlate_backward(call, workspace.value_gradients, reference + channel, channel, channels,
                                       workspace.row, false);
                    gradient = workspace.row;
                    share = 1.0f;
                }
                for (int64_t number = 0; number < count; number++) {
                    const int64_t v = workspace.visible_views[number];
                    const S *source = source_pointer<S>(call, scene, v) + channel;
                    if (needs_index)
                        index_gradient<2>(call, tiles[v], s, source, axes, channels, gradient,
                                          site_gradients[v].grad_index);
                    if (sums.first)
                        scatter<2>(call, tiles[v], s, sums.first + v * sums.view, sums.axes, channels, gradient, share);
                    if (to_reference)
                        gather<2>(call, tiles[v], s, source, axes, channels, workspace.sampled, 1.0f, number > 0);
                }
                if (to_reference)
                    correlate_backward(call, workspace.value_gradients, workspace.sampled, channel, channels,
                                       to_reference, true);
                continue;
            }
            if (reference)
                count = gather_visible<S>(plan, tiles, s, 0, call.channels, appended > 0, reference, workspace);
            else count = gather_visible<S>(plan, tiles, s, channel, channels, appended > 0, nullptr, workspace);
            const float *gradients[3];
            for (int64_t block = 0; block < call.statistics; block++)
                gradients[block] = blocks[block].first + s * blocks[block].step;
            statistics_backward(call, workspace.values, count, width, gradients, workspace.value_gradients);
            for (int64_t v = 0, next = 0; v < call.views; v++) {
                const bool visible = next < count && workspace.visible_views[next] == v;
                const float *gradient = visible ? workspace.value_gradients + next * width : workspace.zeros;
                next += visible;
                if (appended)
                    load_extra_gradients(call, tiles[v], s, gradient + (visible ? features : 0), site_gradients[v]);
                if (needs_index)
                    for (int axis = 0; axis < 2; axis++) site_gradients[v].grad_index[axis][s] = 0.0f;
                if (!visible) continue;
                const S *source = source_pointer<S>(call, scene, v) + channel;
                if (to_reference) {
                    gather<2>(call, tiles[v], s, source, axes, channels, workspace.sampled);
                    correlate_backward(call, gradient, workspace.sampled, channel, channels, to_reference, true);
                }
                if (reference) {
                    correlate_backward(call, gradient, reference + channel, channel, channels, workspace.row, false);
                    gradient = workspace.row;
                }
                if (needs_index) {
                    index_gradient<2>(call, tiles[v], s, source, axes, channels, gradient,
                                      site_gradients[v].grad_index);
                }
                if (!sums.first) continue;
                scatter<2>(call, tiles[v], s, sums.first + v * sums.view, sums.axes, channels, gradient);
            }
        }
        for (int64_t v = 0; v < call.views; v++) store_geometry_gradients(plan, tiles[v], chunk, site_gradients[v]);
    }
}
