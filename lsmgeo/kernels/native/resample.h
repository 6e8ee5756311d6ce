// The arithmetic of all kernels, in float32. Included once for each instruction set, inside a namespace.
//
// Sites are visited in tiles: runs along one axis of the lattice. Of a tile the places in the source are found first,
// in loops that the compiler turns into vector code; then each site mixes the channels of its taps, again in vectors.

#include "vectors.h"

#include "places.h"

#include "forward.h"

#include "backward.h"

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
