// Memory of sources and of their gradients. Included by resample.h.

// Sources are read with adjacent channels. Of others a copy is filled where it is read, in segments of a row, by
// whichever thread needs one first; `ready` says how far each is.

template <class T>
inline void copy_segment(const Call &call, int64_t row_start, int64_t copy_start, int64_t count) {
    const T *from = static_cast<const T *>(call.original) + row_start;
    T *to = static_cast<T *>(const_cast<void *>(call.source)) + copy_start;
    const int64_t across = call.original_stride[2], along = call.original_stride[5];
    for (int64_t c = 0; c < call.channels; c++)
        for (int64_t x = 0; x < count; x += 64 / int64_t(sizeof(T))) __builtin_prefetch(from + c * across + x * along);
    if (along == 1) return transpose(from, across, to, call.source_stride[4], call.channels, count);
    for (int64_t x = 0; x < count; x++)
        for (int64_t c = 0; c < call.channels; c++) to[x * call.source_stride[4] + c] = from[x * along + c * across];
}

inline void fill_segment(const Call &call, const Tile &tile, int64_t z, int64_t y, int64_t part, uint8_t *ready) {
    uint8_t expected = UNTOUCHED;
    if (!__atomic_compare_exchange_n(ready, &expected, BEING_FILLED, false, __ATOMIC_ACQUIRE, __ATOMIC_ACQUIRE)) {
        while (__atomic_load_n(ready, __ATOMIC_ACQUIRE) != READY) std::this_thread::yield();
        return;
    }
    const int64_t *from = call.original_stride, *to = call.source_stride, first = part * SEGMENT;
    const int64_t row = tile.scene * from[0] + tile.view * from[1] + z * from[3] + y * from[4] + first * from[5];
    const int64_t copy = tile.scene * to[0] + tile.view * to[1] + z * to[2] + y * to[3] + first * to[4];
    const int64_t count = std::min(SEGMENT, call.size[0] - first);
    if (call.source_type == FLOAT32) copy_segment<float>(call, row, copy, count);
    else copy_segment<uint16_t>(call, row, copy, count);
    __atomic_store_n(ready, uint8_t(READY), __ATOMIC_RELEASE);
}

// Fills what the sites of a tile read.
template <int DIMS>
inline void fill_copy(const Call &call, const Tile &tile) {
    const int64_t *stride = call.source_stride, parts = (call.size[0] + SEGMENT - 1) / SEGMENT;
    const int64_t rows = (tile.scene * stride[0] + tile.view * stride[1]) / stride[3];
    uint8_t *ready = call.ready + rows * parts;
    int32_t before[3] = {-2, -2, -2};
    for (int s = 0; s < int(tile.count); s++) {
        if (!tile.in_range[s]) continue;
        const int32_t x = tile.cell[0][s], y = tile.cell[1][s], z = DIMS == 3 ? tile.cell[2][s] : 0;
        if (x == before[0] && y == before[1] && z == before[2]) continue;
        before[0] = x, before[1] = y, before[2] = z;
        const int64_t first = std::max(x, 0) / SEGMENT, last = std::min<int64_t>(x + 1, call.size[0] - 1) / SEGMENT;
        const int64_t last_y = std::min<int64_t>(y + 1, call.size[1] - 1);
        const int64_t last_z = DIMS == 3 ? std::min<int64_t>(z + 1, call.size[2] - 1) : 0;
        for (int64_t k = std::max(z, 0); k <= last_z; k++)
            for (int64_t j = std::max(y, 0); j <= last_y; j++)
                for (int64_t part = first; part <= last; part++) {
                    uint8_t *at = ready + (k * call.size[1] + j) * parts + part;
                    if (__atomic_load_n(at, __ATOMIC_ACQUIRE) != READY) fill_segment(call, tile, k, j, part, at);
                }
    }
}

template <int DIMS>
inline void locate(const Call &call, const View &view, Tile &tile) {
    if (call.kind != SAMPLE_VIEWS)
        for (int s = 0; s < int(tile.count); s++) tile.x[s] = float(call.x[tile.i + (tile.along_z ? 0 : s)]);
    if (DIMS == 3) project_to_voxels(call, view, tile);
    else if (call.kind == SAMPLE_VIEWS) load_pixels(call, tile);
    else if (call.depths) project_depths_to_pixels(call, view, tile);
    else project_to_pixels(call, view, tile);
    if (call.direction) ray_directions(call, view, tile);
    interpolation_weights<DIMS>(call, tile);
    if (call.original) fill_copy<DIMS>(call, tile);
}

template <class S>
inline const S *source_pointer(const Call &call, int64_t scene, int64_t view) {
    return static_cast<const S *>(call.source) + scene * call.source_stride[0] + view * call.source_stride[1];
}

inline void axis_strides(const int64_t *stride, int64_t *axes) {  // to the order x, y, z
    axes[0] = stride[4];
    axes[1] = stride[3];
    axes[2] = stride[2];
}

// Where a task sums gradients to some channels of its views' sources, in float32: the gradient's own memory, or that of
// the thread, to be rounded once. `first` is null where no such gradient is needed.
struct Sums {
    float *first;
    int64_t view, axes[3];
    int64_t scene, views, start, channel, channels;  // views from `start`, channels from `channel`
};

template <class Body> INLINE void over_pixels(const Call &call, const Sums &sums, Body body) {
    for (int64_t v = 0; v < sums.views; v++)
        for (int64_t z = 0; z < call.size[2]; z++)
            for (int64_t y = 0; y < call.size[1]; y++) {
                float *row = sums.first + v * sums.view + z * sums.axes[2] + y * sums.axes[1];
                for (int64_t x = 0; x < call.size[0]; x++) body(row + x * sums.axes[0], v, z, y, x);
            }
}

inline int64_t offset_in_gradient(const Call &call, const Sums &sums, int64_t v, int64_t z, int64_t y, int64_t x) {
    const int64_t *stride = call.source_gradient_stride;
    return sums.scene * stride[0] + (sums.start + v) * stride[1] + z * stride[2] + y * stride[3] + x * stride[4] +
           sums.channel;
}

inline Sums start_sums(const Call &call, int64_t scene, int64_t start, int64_t views, int64_t channel, int64_t channels,
                       Workspace &workspace) {
    Sums sums = {nullptr, 0, {}, scene, views, start, channel, channels};
    if (!call.source_gradient) return sums;
    const int64_t *size = call.size;
    if (call.source_gradient_type == FLOAT32) {
        sums.first = static_cast<float *>(call.source_gradient) + offset_in_gradient(call, sums, 0, 0, 0, 0);
        sums.view = call.source_gradient_stride[1];
        axis_strides(call.source_gradient_stride, sums.axes);
    } else {
        sums.first = workspace.sums;
        sums.axes[0] = channels;
        sums.axes[1] = channels * size[0];
        sums.axes[2] = sums.axes[1] * size[1];
        sums.view = sums.axes[2] * size[2];
    }
    if (call.accumulate) return sums;
    over_pixels(call, sums, [&](float *pixel, int64_t, int64_t, int64_t, int64_t) {
        std::memset(pixel, 0, size_t(channels) * sizeof(float));
    });
    return sums;
}

template <class S> inline void round_sums(const Call &call, const Sums &sums) {
    S *gradient = static_cast<S *>(call.source_gradient);
    over_pixels(call, sums, [&](const float *pixel, int64_t v, int64_t z, int64_t y, int64_t x) INLINED {
        convert_row(pixel, sums.channels, gradient + offset_in_gradient(call, sums, v, z, y, x));
    });
}

inline void finish_sums(const Call &call, const Sums &sums) {
    if (!sums.first || call.source_gradient_type == FLOAT32) return;
    if (call.source_gradient_type == BFLOAT16) round_sums<Bfloat16>(call, sums);
    else round_sums<Float16>(call, sums);
}
