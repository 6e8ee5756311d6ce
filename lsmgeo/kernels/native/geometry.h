// Matrices of `Sites` from cameras, composed and checked in float64 as lsmgeo/_sites.py does with tensors.

// What is composed, as numbered in composing.py.
enum Composed { CHECKS, IMAGES, FRUSTUMS, LATTICE };

// The arguments of a call; composing.py packs the same fields in the same order, 8 bytes each.
struct Geometry {
    int64_t composed, scenes, views;
    int64_t doubles;                        // whether the cameras are float64; float32 otherwise
    const void *intrinsics, *extrinsics;    // (B, V, 3, 3) and (B, V, 4, 4)
    int64_t intrinsics_stride[4], extrinsics_stride[4];
    const double *height, *width;           // (B, V)
    const uint8_t *view_mask;               // (B, V), or null
    double new_height, new_width;
    const double *grid;                     // world from lattice, (4, 4) or (B, 4, 4); null for CHECKS and LATTICE
    int64_t grid_stride;
    int64_t frame;                          // of the directions: 0 for none, 1 for the world's, 2 for the camera's
    double *matrix, *direction;             // (B, V, 3, 4), or (B, V, 4, 4) for LATTICE; null where not composed
};

struct CameraValues { double K[3][3], E[4][4], height, width; };

void load_matrix(const Geometry &call, const void *from, int64_t at, const int64_t *stride, int size, double *to) {
    for (int row = 0; row < size; row++)
        for (int column = 0; column < size; column++) {
            const int64_t place = at + row * stride[2] + column * stride[3];
            to[row * size + column] = call.doubles ? static_cast<const double *>(from)[place]
                                                   : double(static_cast<const float *>(from)[place]);
        }
}

// The rules of `check_cameras`; a NaN fails each.
bool is_valid(const CameraValues &camera) {
    const auto &K = camera.K;
    const auto &E = camera.E;
    for (const auto &row : K)
        for (double value : row)
            if (!std::isfinite(value)) return false;
    for (const auto &row : E)
        for (double value : row)
            if (!std::isfinite(value)) return false;
    const double side = std::max(camera.height, camera.width);
    if (!(camera.height >= 1.0 && camera.width >= 1.0)) return false;
    if (!(std::fabs(K[2][0]) <= 1e-3 && std::fabs(K[2][1]) <= 1e-3 && std::fabs(K[2][2] - 1.0) <= 1e-3)) return false;
    if (!(std::fabs(K[0][0] * K[1][1] - K[0][1] * K[1][0]) > 1e-12 * (side * side))) return false;
    for (int column = 0; column < 4; column++)
        if (!(std::fabs(E[3][column] - (column == 3)) <= 1e-3)) return false;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const double product = E[0][i] * E[0][j] + E[1][i] * E[1][j] + E[2][i] * E[2][j];
            if (!(std::fabs(product - (i == j)) <= 1e-3)) return false;
        }
    const double determinant = E[0][0] * (E[1][1] * E[2][2] - E[1][2] * E[2][1]) +
                               E[0][1] * (E[1][2] * E[2][0] - E[1][0] * E[2][2]) +
                               E[0][2] * (E[1][0] * E[2][1] - E[1][1] * E[2][0]);
    return determinant > 0.0;
}

// The adjugate over the determinant.
void invert(const double (&m)[3][3], double (&inverse)[3][3]) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const int a = (i + 1) % 3, b = (i + 2) % 3, c = (j + 1) % 3, d = (j + 2) % 3;
            inverse[j][i] = m[a][c] * m[b][d] - m[a][d] * m[b][c];
        }
    const double determinant = m[0][0] * inverse[0][0] + m[0][1] * inverse[1][0] + m[0][2] * inverse[2][0];
    for (auto &row : inverse)
        for (double &value : row) value /= determinant;
}

// The product of (rows, 4) and (4, 4).
void multiply(const double *left, const double *right, int rows, double *product) {
    for (int row = 0; row < rows; row++)
        for (int column = 0; column < 4; column++) {
            double sum = 0.0;
            for (int inner = 0; inner < 4; inner++) sum += left[4 * row + inner] * right[4 * inner + column];
            product[4 * row + column] = sum;
        }
}

// The matrices of one view, from its valid camera, or that of a masked view, and the grid's matrix.
void compose_view(const Geometry &call, const CameraValues &camera, const double *grid, int64_t at) {
    const auto &E = camera.E;
    double K[3][3] = {{}, {}, {0.0, 0.0, 1.0}};  // resized
    const double scales[2] = {call.new_width / camera.width, call.new_height / camera.height};
    for (int row = 0; row < 2; row++)
        for (int column = 0; column < 3; column++)
            K[row][column] = scales[row] * camera.K[row][column] + (0.5 * scales[row] - 0.5) * (column == 2);
    double centre[3];
    for (int axis = 0; axis < 3; axis++)
        centre[axis] = -(E[0][axis] * E[0][3] + E[1][axis] * E[1][3] + E[2][axis] * E[2][3]);

    double frustum[16] = {};  // world from (u, v, 1 / depth, 1)
    if (call.composed != IMAGES) {
        double inverse[3][3];
        invert(K, inverse);
        frustum[14] = 1.0;
        for (int row = 0; row < 3; row++) {
            for (int column = 0; column < 3; column++)
                frustum[4 * row + (column < 2 ? column : 3)] =
                    E[0][row] * inverse[0][column] + E[1][row] * inverse[1][column] + E[2][row] * inverse[2][column];
            frustum[4 * row + 2] = centre[row];
        }
        if (call.composed == LATTICE) return void(std::copy(frustum, frustum + 16, call.matrix + 16 * at));
    }
    double projection[12];  // of a point of the world to the source's index
    const double *world = call.composed == IMAGES ? grid : frustum;
    if (call.composed == IMAGES) {
        for (int row = 0; row < 3; row++)
            for (int column = 0; column < 4; column++)
                projection[4 * row + column] =
                    K[row][0] * E[0][column] + K[row][1] * E[1][column] + K[row][2] * E[2][column];
    } else {
        double linear[3][3], inverse[3][3];
        for (int entry = 0; entry < 9; entry++) linear[entry / 3][entry % 3] = grid[4 * (entry / 3) + entry % 3];
        invert(linear, inverse);
        for (int row = 0; row < 3; row++) {
            std::copy(inverse[row], inverse[row] + 3, projection + 4 * row);
            projection[4 * row + 3] =
                -(inverse[row][0] * grid[3] + inverse[row][1] * grid[7] + inverse[row][2] * grid[11]);
        }
    }
    multiply(projection, world, 3, call.matrix + 12 * at);
    double *direction = call.direction + 12 * at;
    if (call.frame == 2) multiply(&E[0][0], world, 3, direction);
    if (call.frame == 1)
        for (int row = 0; row < 3; row++)
            for (int column = 0; column < 4; column++)
                direction[4 * row + column] = world[4 * row + column] - centre[row] * world[12 + column];
}

// 0, or 1 + the index of the first invalid camera; views that are masked are not read.
int64_t compose(const Geometry &call) {
    for (int64_t at = 0; at < call.scenes * call.views; at++) {
        const int64_t scene = at / call.views, view = at % call.views;
        CameraValues camera = {};
        if (call.view_mask && !call.view_mask[at]) {
            for (int axis = 0; axis < 4; axis++) camera.E[axis][axis] = 1.0;
            for (int axis = 0; axis < 3; axis++) camera.K[axis][axis] = 1.0;
            camera.height = camera.width = 1.0;
        } else {
            const int64_t *K = call.intrinsics_stride, *E = call.extrinsics_stride;
            load_matrix(call, call.intrinsics, scene * K[0] + view * K[1], K, 3, &camera.K[0][0]);
            load_matrix(call, call.extrinsics, scene * E[0] + view * E[1], E, 4, &camera.E[0][0]);
            camera.height = call.height[at];
            camera.width = call.width[at];
            // A lattice is that of a camera that was checked when its grid was made.
            if (call.composed != LATTICE && !is_valid(camera)) return 1 + at;
        }
        if (call.composed != CHECKS) compose_view(call, camera, call.grid + scene * call.grid_stride, at);
    }
    return 0;
}
