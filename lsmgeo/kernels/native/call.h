// The arguments of a call. Plain C layout: lsmgeo/kernels/native/library.py mirrors `Call`.
#pragma once

#include <cstdint>

enum Kind : int64_t { UNPROJECT = 0, SAMPLE_VIEWS = 1, PLANE_SWEEP_PROJECT = 2 };
enum Type : int64_t { FLOAT32 = 0, BFLOAT16 = 1, FLOAT16 = 2, FLOAT64 = 3 };
enum Statistic : int64_t { MEAN = 0, VARIANCE = 1, MAX = 2 };

// Strides count elements. Axes of sources: scene, view, z, y, x; the channel's stride is 1. Axes of values and their
// gradient: scene, view, channel, z, y, x; the view's stride is 0 where views are reduced.
struct Call {
    int64_t kind, threads;
    int64_t scenes, views, channels;
    int64_t size[3];               // of a source: x, y, z; z is 1 for images
    int64_t sites[3];              // of the lattice: x, y, z; (N, 1, 1) for pixels
    int64_t nearest, border, projective;
    int64_t depth, direction, extra;  // channels appended: 0 or 1, 0 or 1 (that is 3 channels), any number
    int64_t statistics, statistic[3];
    double near;

    const void *source;
    int64_t source_type, source_stride[5];
    const void *original;          // in place of `source` where its channels are not adjacent; or null
    int64_t original_stride[6];    // scene, view, channel, z, y, x
    uint8_t *ready;                // set by the kernels, see copies.h
    const double *matrix, *direction_matrix;  // (B, V, 3, 4), or null
    const double *x, *y, *z;
    int64_t z_stride[3];           // scene, view, plane
    const void *depths;            // of each site in place of z, or null
    int64_t depths_type, depths_stride[5];  // FLOAT32 or FLOAT64; scene, view, z, y, x
    const void *reference;         // to correlate the samples with, of the source's type, or null
    int64_t reference_stride[6], groups;    // scene, view, channel, z, y, x; groups of channels, 0 without a reference
    double share;                  // of a product in the value of its group: 1 for sums
    const uint8_t *view_mask;      // (B, V), or null
    const float *pixels;           // (B, V, N, 2)
    const uint8_t *front;          // (B, V, N)
    const float *extras;           // (B, V, N, E)

    void *values;
    int64_t values_type, values_stride[6];
    uint8_t *visible;              // (B, V, *sites)

    const void *gradient;
    int64_t gradient_type, gradient_stride[6];
    int64_t chunks, accumulate;    // parts of the channels; whether the source's gradient is added to what is there
    int64_t whole_scenes;          // whether one task has all views of a scene, as their gradients meet in memory
    void *source_gradient;         // of the source's type, or float32
    int64_t source_gradient_type;
    int64_t source_gradient_stride[5];
    double *matrix_gradient, *direction_gradient;  // (B, V, chunks, 3, 4), or null
    double *z_gradient;            // (B, V, chunks, D), or null
    float *depths_gradient;        // (chunks, B, V or 1, D, H, W), or null
    int64_t depths_gradient_stride[3];      // chunk, scene, view
    float *reference_gradient;     // channels adjacent, cleared, or null
    int64_t reference_gradient_stride[5];   // scene, view, z, y, x
    float *pixels_gradient;        // (chunks, B, V, N, 2), or null
    float *extras_gradient;        // (B, V, N, E), or null
};
