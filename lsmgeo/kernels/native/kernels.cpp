// Fused resampling on the CPU: a C library without Python or PyTorch; lsmgeo/kernels/native/library.py calls it.
//
// resample.h is compiled for several instruction sets; loading the library selects the best that the machine has.
// Work is split into tasks that write to separate memory, so that results depend neither on which thread runs which
// task nor on their order.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <exception>
#include <memory>
#include <new>
#include <thread>
#include <type_traits>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(LSMGEO_ONE_SET)
#define VARIANTS 1
#include <immintrin.h>
#endif

#include "call.h"

#if defined(_WIN32)
#define EXPORT extern "C" __declspec(dllexport)
#else
#define EXPORT extern "C" __attribute__((visibility("default")))
#endif

// Functions on vectors are inlined: vectors must not be passed between functions.
#define INLINE inline __attribute__((always_inline))
#define INLINED __attribute__((always_inline))

namespace {

// The matrices of a view, in the scale in which the kernels compute.
struct View {
    double matrix[3][4], scale;              // M times a power of two that keeps M q from overflow
    double direction[3][4], direction_scale; // G times a power of two that brings it near 1
    double terms, terms_z;                   // bound on the terms of G q: terms + terms_z |z|
    bool masked;
};

struct Plan {
    const Call *call;
    const View *views;       // (B, V)
    int64_t features;        // channels of a view's values: those of the source, or groups of them correlated
    int64_t channels;        // of a view's values, with the geometric ones
    int64_t tiles, tiles_per_row, blocks;
    bool along_z, backward;
};

#include "copies.h"

struct TileSizes { int64_t tile, site_gradients, length; };  // bytes, bytes, sites

// The memory of one thread.
struct Workspace {
    void *tiles, *site_gradients;
    float *values, *reduced, *value_gradients, *zeros;
    float *reference, *sampled, *row;  // of a tile; of one site: the source's channels, and their gradient
    float *sums;                       // of gradients to be rounded
    int64_t *visible_views;
};

#define LANES 4
namespace baseline {
#include "resample.h"
}

// LSMGEO_ONE_SET builds only the first, in a fraction of the time.
#if VARIANTS
#pragma GCC push_options
#pragma GCC target("avx2,fma,bmi2,f16c")
#undef LANES
#define LANES 8
namespace avx2 {
#include "resample.h"
}
#pragma GCC pop_options
#pragma GCC push_options
#pragma GCC target("avx512f,avx512bw,avx512dq,avx512vl,avx2,fma,bmi2,f16c,prefer-vector-width=512")
#undef LANES
#define LANES 16
namespace avx512 {
#include "resample.h"
}
#pragma GCC pop_options
#endif

using Runner = void (*)(const Plan &, int64_t, Workspace &);
struct InstructionSet { const char *name; Runner run; TileSizes sizes; };

// The sets that this machine can run, best first.
std::vector<InstructionSet> available() {
    std::vector<InstructionSet> sets;
#if VARIANTS
    __builtin_cpu_init();
    const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                          __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("f16c");
    if (has_avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        sets.push_back({"avx512", avx512::run_task, avx512::tile_sizes()});
    if (has_avx2) sets.push_back({"avx2", avx2::run_task, avx2::tile_sizes()});
#endif
    sets.push_back({"baseline", baseline::run_task, baseline::tile_sizes()});
    return sets;
}

InstructionSet chosen = available().front();

// Threads of the OpenMP runtime that PyTorch has loaded already, so that two pools do not compete for the cores.
using OpenMp = void (*)(void (*)(void *), void *, unsigned, unsigned);
OpenMp openmp = nullptr;

template <class Body>
void run_on_threads(int64_t threads, Body &body) {
    auto call = [](void *argument) { (*static_cast<Body *>(argument))(); };
    if (threads <= 1) return call(&body);
    if (openmp) return openmp(call, &body, unsigned(threads), 0);
    std::vector<std::thread> others;
    others.reserve(size_t(threads));
    for (int64_t number = 1; number < threads; number++) {
        try {
            others.emplace_back(call, &body);
        } catch (const std::exception &) {
            break;  // fewer threads do the same work
        }
    }
    call(&body);
    for (auto &other : others) other.join();
}

double power_of_two_above(double value) { return std::exp2(std::ceil(std::log2(value))); }

double max_abs(const double *values, int64_t count, int64_t stride = 1) {
    double largest = 0.0;
    for (int64_t number = 0; number < count; number++) largest = std::max(largest, std::fabs(values[number * stride]));
    return largest;
}

void prepare_view(const Call &call, int64_t scene, int64_t number, double reach_x, double reach_y, View &view) {
    const int64_t at = scene * call.views + number;
    view.masked = call.view_mask && !call.view_mask[at];
    double reach_z = 1.0;  // homogeneous, see `load_depths`
    if (!call.depths) {
        const double *z = call.z + scene * call.z_stride[0] + number * call.z_stride[1];
        reach_z = max_abs(z, call.sites[2], call.z_stride[2]);
    }
    auto bound = [](const double *matrix, double *columns) {
        for (int column = 0; column < 4; column++) columns[column] = max_abs(matrix + column, 3, 4);
    };
    double columns[4];
    const double *matrix = call.matrix + 12 * at;
    view.scale = 1.0;
    if (call.kind == UNPROJECT) {
        bound(matrix, columns);
        const double extent = columns[0] * reach_x + columns[1] * reach_y + columns[2] * reach_z + columns[3];
        if (extent > 0x1p100) view.scale = 1.0 / power_of_two_above(extent * 0x1p-100);
    }
    for (int entry = 0; entry < 12; entry++) view.matrix[entry / 4][entry % 4] = matrix[entry] * view.scale;
    if (!call.direction) return;
    const double *direction = call.direction_matrix + 12 * at;
    const double largest = max_abs(direction, 12);
    view.direction_scale = largest > 0.0 ? 1.0 / power_of_two_above(largest) : 1.0;
    for (int entry = 0; entry < 12; entry++)
        view.direction[entry / 4][entry % 4] = direction[entry] * view.direction_scale;
    bound(&view.direction[0][0], columns);
    view.terms = columns[0] * reach_x + columns[1] * reach_y + columns[3];
    view.terms_z = columns[2];
}

// Ask for huge pages: a fresh page of 4 KiB costs about as much as filling it.
void use_huge_pages(void *start, int64_t bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    const uintptr_t huge = uintptr_t(1) << 21;
    const uintptr_t first = (reinterpret_cast<uintptr_t>(start) + huge - 1) & ~(huge - 1);
    const uintptr_t last = (reinterpret_cast<uintptr_t>(start) + uintptr_t(bytes)) & ~(huge - 1);
    if (first < last) madvise(reinterpret_cast<void *>(first), last - first, MADV_HUGEPAGE);
#else
    (void)start;
    (void)bytes;
#endif
}

// Run a call; nonzero when memory ran out.
int run(const Call &call, bool backward) {
    Plan plan = {};
    plan.call = &call;
    plan.backward = backward;
    plan.features = call.groups ? call.groups : call.channels;
    plan.channels = plan.features + call.depth + 3 * call.direction + call.extra;
    // Tiles run along z where neighbours in z are adjacent in memory.
    const int64_t *stride = backward ? call.gradient_stride : call.values_stride;
    plan.along_z = call.kind == PLANE_SWEEP_PROJECT && call.sites[2] > 1 && stride[3] != 0 && stride[3] < stride[5];
    const int64_t length = plan.along_z ? call.sites[2] : call.sites[0];
    const int64_t sites = call.sites[0] * call.sites[1] * call.sites[2];
    if (sites == 0 || call.scenes == 0 || call.views == 0) return 0;
    plan.tiles_per_row = (length + chosen.sizes.length - 1) / chosen.sizes.length;
    plan.tiles = sites / length * plan.tiles_per_row;
    // A few thousand sites for each task, fewer where each costs more.
    const int64_t cost = std::max(plan.channels, call.channels) + 16;
    const int64_t work = 1 + sites * cost * (call.statistics ? call.views : 1) / 131072;
    plan.blocks = std::min(plan.tiles, work);
    const bool whole_scenes = call.statistics || (backward && call.whole_scenes);
    const int64_t parts = call.scenes * (whole_scenes ? 1 : call.views);
    const int64_t tasks = parts * (backward ? call.chunks : plan.blocks);

    std::unique_ptr<View[]> views(new (std::nothrow) View[size_t(call.scenes * call.views)]());
    if (!views) return 1;
    plan.views = views.get();
    if (call.kind != SAMPLE_VIEWS) {
        const double reach_x = max_abs(call.x, call.sites[0]), reach_y = max_abs(call.y, call.sites[1]);
        for (int64_t scene = 0; scene < call.scenes; scene++)
            for (int64_t view = 0; view < call.views; view++)
                prepare_view(call, scene, view, reach_x, reach_y, views[size_t(scene * call.views + view)]);
    }

    const int64_t tiles = call.statistics ? call.views : 1;
    const int64_t statistics = std::max<int64_t>(call.statistics, 1);
    const int64_t value_floats = std::max(chosen.sizes.length, call.statistics ? call.views : 0) * plan.channels;
    const int64_t of_reference = call.groups ? call.channels : 0;
    const int64_t floats = 2 * value_floats + statistics * chosen.sizes.length * plan.channels + plan.channels +
                           (chosen.sizes.length + 2) * of_reference;
    int64_t sums = 0;
    if (backward && call.source_gradient && call.source_gradient_type != FLOAT32)
        sums = (call.statistics ? call.views : 1) * call.size[0] * call.size[1] * call.size[2] *
               ((call.channels + call.chunks - 1) / call.chunks);
    const int64_t bytes = tiles * (chosen.sizes.tile + chosen.sizes.site_gradients) + 4 * (floats + sums) +
                          8 * call.views + 512;
    // Each thread starts with its own part and then helps the others: two threads next to each other would fault in,
    // and clear, the same fresh pages.
    const int64_t threads = std::max<int64_t>(1, std::min(call.threads, tasks));
    // Where each thread has several views, or scenes, to itself, it copies one at a time; else all share one copy.
    const int64_t views_of_task = call.kind == PLANE_SWEEP_PROJECT || !whole_scenes ? 1 : call.views;
    const int64_t images = call.kind == PLANE_SWEEP_PROJECT || whole_scenes ? call.scenes : parts;
    const int64_t tasks_of_image = tasks / images;
    const bool share = images < 2 * threads;
    Copies shared;
    if (share && !shared.reserve(call, call.scenes, call.kind == PLANE_SWEEP_PROJECT ? 1 : call.views)) return 1;
    std::unique_ptr<std::atomic<int64_t>[]> next(new (std::nothrow) std::atomic<int64_t>[size_t(threads)]);
    if (!next) return 1;
    for (int64_t part = 0; part < threads; part++) next[size_t(part)] = part * tasks / threads;
    std::atomic<int64_t> arrived(0);
    auto body = [&]() {
        std::unique_ptr<char[]> memory(new (std::nothrow) char[size_t(bytes)]);
        if (!memory) return;
        if (sums) use_huge_pages(memory.get(), bytes);
        Copies its_own;
        if (!share && !its_own.reserve(call, 1, views_of_task)) return;
        Plan plan_of_thread = plan;
        plan_of_thread.call = share ? &shared.call : &its_own.call;
        int64_t image = -1;
        Workspace workspace;
        char *place = memory.get();
        auto reserve = [&](int64_t size) {
            place = reinterpret_cast<char *>((reinterpret_cast<uintptr_t>(place) + 15) & ~uintptr_t(15));
            char *reserved = place;
            place += size;
            return reserved;
        };
        workspace.visible_views = reinterpret_cast<int64_t *>(reserve(8 * call.views));
        workspace.tiles = reserve(tiles * chosen.sizes.tile);
        workspace.site_gradients = reserve(tiles * chosen.sizes.site_gradients);
        workspace.values = reinterpret_cast<float *>(reserve(4 * value_floats));
        workspace.value_gradients = reinterpret_cast<float *>(reserve(4 * value_floats));
        workspace.reduced = reinterpret_cast<float *>(reserve(4 * statistics * chosen.sizes.length * plan.channels));
        workspace.zeros = reinterpret_cast<float *>(reserve(4 * plan.channels));
        workspace.reference = reinterpret_cast<float *>(reserve(4 * chosen.sizes.length * of_reference));
        workspace.sampled = reinterpret_cast<float *>(reserve(4 * of_reference));
        workspace.row = reinterpret_cast<float *>(reserve(4 * of_reference));
        workspace.sums = reinterpret_cast<float *>(reserve(4 * sums));
        std::fill(workspace.zeros, workspace.zeros + plan.channels, 0.0f);
        const int64_t own = arrived++;
        for (int64_t offset = 0; offset < threads; offset++) {
            const int64_t part = (own + offset) % threads, last = (part + 1) * tasks / threads;
            std::atomic<int64_t> &counter = next[size_t(part)];
            for (int64_t task = counter++; task < last; task = counter++) {
                if (!share && task / tasks_of_image != image) its_own.forget();
                image = task / tasks_of_image;
                chosen.run(plan_of_thread, task, workspace);
            }
        }
    };
    run_on_threads(threads, body);
    return arrived.load() == 0 ? 1 : 0;  // one thread with memory does all the work
}

}  // namespace

EXPORT int lsmgeo_forward(const Call *call) { return run(*call, false); }

EXPORT int lsmgeo_backward(const Call *call) { return run(*call, true); }

EXPORT int64_t lsmgeo_size_of_call() { return int64_t(sizeof(Call)); }

// Use the threads of an OpenMP runtime: the address of its GOMP_parallel, or null to start threads here.
EXPORT void lsmgeo_use_openmp(void *parallel) { openmp = reinterpret_cast<OpenMp>(parallel); }

// The instruction set in use, after selecting one by name if given; null if the machine does not have it.
EXPORT const char *lsmgeo_instruction_set(const char *name) {
    if (name)
        for (const auto &set : available())
            if (std::strcmp(set.name, name) == 0) {
                chosen = set;
                return chosen.name;
            }
    return name ? nullptr : chosen.name;
}

EXPORT void lsmgeo_use_huge_pages(void *start, int64_t bytes) { use_huge_pages(start, bytes); }
