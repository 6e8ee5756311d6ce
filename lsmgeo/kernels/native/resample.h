// The arithmetic of all kernels, in float32. Included once for each instruction set, inside a namespace.
//
// Sites are visited in tiles: runs along one axis of the lattice. The positions of a tile in the source are computed
// first, in loops that the compiler vectorises; then each site interpolates the channels of its taps, also in vectors.

#include "simd.h"

#include "sampling.h"

#include "sources.h"

#include "forward.h"

#include "backward.h"

// One task of a call, by its number.
template <class S>
void task(const Plan &plan, int64_t number, Workspace &workspace) {
    const Call &call = *plan.call;
    if (!plan.backward) {
        const int64_t block = number % plan.blocks, rest = number / plan.blocks;
        const int64_t first = block * plan.tiles / plan.blocks, last = (block + 1) * plan.tiles / plan.blocks;
        if (call.statistics) reduce<S>(plan, rest, first, last, workspace);
        else if (call.kind == PLANE_SWEEP_PROJECT)
            sample<3, S>(plan, rest / call.views, rest % call.views, first, last, workspace);
        else sample<2, S>(plan, rest / call.views, rest % call.views, first, last, workspace);
        return;
    }
    const int64_t chunk = number % call.chunks, rest = number / call.chunks;
    const int64_t channel = chunk * call.channels / call.chunks;
    const int64_t channels = (chunk + 1) * call.channels / call.chunks - channel;
    auto with_sums = [&](int64_t scene, int64_t start, int64_t views, auto body) {
        const Sums sums = start_sums(call, scene, start, views, channel, channels, workspace);
        body(sums);
        finish_sums(call, sums);
    };
    auto one_view = [&](int64_t scene, int64_t v) {
        with_sums(scene, v, 1, [&](const Sums &sums) { sample_backward<2, S>(plan, v, chunk, sums, workspace); });
    };
    if (call.statistics) {
        with_sums(rest, 0, call.views,
                  [&](const Sums &sums) { reduce_backward<S>(plan, chunk, sums, workspace); });
    } else if (call.kind == PLANE_SWEEP_PROJECT) {  // the views of a scene share its volume
        with_sums(rest, 0, 1, [&](const Sums &sums) {
            for (int64_t v = 0; v < call.views; v++) sample_backward<3, S>(plan, v, chunk, sums, workspace);
        });
    } else if (call.whole_scenes) {
        for (int64_t v = 0; v < call.views; v++) one_view(rest, v);
    } else {
        one_view(rest / call.views, rest % call.views);
    }
}

inline void run_task(const Plan &plan, int64_t number, Workspace &workspace) {
    if (plan.call->source_type == FLOAT32) task<float>(plan, number, workspace);
    else if (plan.call->source_type == BFLOAT16) task<Bfloat16>(plan, number, workspace);
    else task<Float16>(plan, number, workspace);
}

inline TileSizes tile_sizes() { return {sizeof(Tile), sizeof(SiteGradients), TILE}; }
