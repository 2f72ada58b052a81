// Part 1 of 3 of the function that solves one world (see source.py): the lanes' exchange, and what the world is.
//
// Lane j < NV has dof j: column j of the inertia matrix, its dry friction (a row of the constraints by itself), its
// entries of all vectors. The other rows, equalities, limits and contacts, lie in shared memory, their Jacobian dense.

constexpr int NV = $NV, STRIDE = $STRIDE, ROWS = $ROWS, SIZE = $SIZE;
constexpr int SATISFIED = $SATISFIED, QUADRATIC = $QUADRATIC, LINEARNEG = $LINEARNEG, LINEARPOS = $LINEARPOS;
constexpr int CONE = $CONE, CONTACT_ELLIPTIC = $CONTACT_ELLIPTIC;
constexpr int ITERATIONS_OVERFLOW = $ITERATIONS_BIT, LS_OVERFLOW = $LS_BIT;
constexpr float TINY = (float)$MINVAL, NOISE = 8.0f * 1.1920929e-07f;

const int thread = WP_TILE_THREAD_IDX;
const int lane = thread & 31;

#if defined(__CUDA_ARCH__)
__shared__ __align__(16) float memory[WP_TILE_BLOCK_DIM / 32][SIZE];
auto sync = [&]() { __syncwarp(); };
auto from = [&](float v, int l) { return __shfl_sync(0xffffffffu, v, l); };
auto other = [&](float v, int mask) { return __shfl_xor_sync(0xffffffffu, v, mask); };
auto ballot = [&](bool yes) { return (unsigned)__ballot_sync(0xffffffffu, yes); };
auto ones = [&](unsigned bits) { return __popc(bits); };
#else
alignas(16) static float memory[WP_TILE_BLOCK_DIM / 32 > 0 ? WP_TILE_BLOCK_DIM / 32 : 1][SIZE];
static float exchange[WP_TILE_BLOCK_DIM < 32 ? 32 : WP_TILE_BLOCK_DIM];
auto sync = [&]() { WP_TILE_SYNC(); };
auto from = [&](float v, int l) {
    exchange[thread] = v;
    WP_TILE_SYNC();
    const float out = exchange[(thread & ~31) + l];
    WP_TILE_SYNC();
    return out;
};
auto other = [&](float v, int mask) {
    exchange[thread] = v;
    WP_TILE_SYNC();
    const float out = exchange[thread ^ mask];
    WP_TILE_SYNC();
    return out;
};
auto ballot = [&](bool yes) {
    exchange[thread] = yes ? 1.0f : 0.0f;
    WP_TILE_SYNC();
    unsigned out = 0;
    for (int l = 0; l < 32; ++l) out |= (unsigned)(exchange[(thread & ~31) + l] != 0.0f) << l;
    WP_TILE_SYNC();
    return out;
};
auto ones = [&](unsigned bits) { return __builtin_popcount(bits); };
#endif
auto total = [&](float v) {
    for (int mask = 16; mask; mask >>= 1) v += other(v, mask);
    return v;
};
auto over = [](float x, float y) { return x / (y != 0.0f ? y : TINY); };
auto larger = [](float x, float y) { return x > y ? x : y; };

const int nefc_all = wp::index(problem.nefc, world);
const int nefc = nefc_all < njmax ? nefc_all : njmax;
const int ne_all = wp::index(problem.ne, world);
const int ne = ne_all < nefc ? ne_all : nefc;  // rows of equalities, which come first, before those of dry friction
const int nf_all = wp::index(problem.nf, world);
const int nf = nf_all < nefc - ne ? nf_all : nefc - ne;
const int rows = nefc - nf;  // equalities, limits and contacts; the rows of dry friction are the lanes' own
auto row_of = [&](int k) { return k < ne ? k : nf + k; };
if (rows <= above || rows > ROWS) return;

float* J = memory[thread >> 5];
float* jar = J + ROWS * STRIDE;
float* jv = jar + ROWS;
float* D = jv + ROWS;
float* scale = D + ROWS;
float* force = scale + ROWS;
float* q0 = force + ROWS;
float* q1 = q0 + ROWS;
float* q2 = q1 + ROWS;
int* kind = (int*)(q2 + ROWS);  // rows of the contact whose first this is; 1: a row by itself; 0: belongs to one before
int* state = kind + ROWS;
int* item = state + ROWS;
float* vec = (float*)(item + ROWS);
float* upper = vec + 32;
constexpr int US = NV | 1;

const bool mine = lane < NV;
const float invsqrt = wp::index(problem.impratio_invsqrt, world % problem.impratio_invsqrt.shape[0]);
const float tolerance = wp::index(problem.tolerance, world % problem.tolerance.shape[0]);
const float ls_tolerance = wp::index(problem.ls_tolerance, world % problem.ls_tolerance.shape[0]);

// ---- this lane's dof: inertia, dry friction
for (int k = lane; k < NV * US; k += 32) upper[k] = 0.0f;
sync();
const int entries = problem.M_colind.shape[0];
#pragma unroll 1
for (int e = lane; e < entries; e += 32) {
    const int i = wp::index(problem.M_rowind, e), j = wp::index(problem.M_colind, e);
    upper[i * US + j] = upper[j * US + i] = wp::index(problem.M, world, e);
}
sync();
float M[NV];
for (int i = 0; i < NV; ++i) M[i] = mine ? upper[i * US + lane] : 0.0f;
float diagonal = 0.0f;
for (int i = 0; i < NV; ++i) diagonal = lane == i ? M[i] : diagonal;
const float inertia_scale = 1.0f / larger(TINY, total(diagonal));

int friction_row = -1;
if (mine && nf > 0) {
    friction_row = wp::index(problem.dof_frictionadr, world, lane);
    if (friction_row >= nefc) friction_row = -1;
}
const bool dry = friction_row >= 0;
float f_D = 0.0f, f_loss = 0.0f, f_jar = 0.0f, f_edge = 0.0f;
float acc = 0.0f, smooth = 0.0f;
if (mine) {
    acc = warm == 2 || (warm == 1 && nefc > 0) ? wp::index(problem.qacc_warmstart, world, lane)
                                               : wp::index(problem.qacc_smooth, world, lane);
    smooth = wp::index(problem.qfrc_smooth, world, lane);
}
if (dry) {
    f_D = wp::index(problem.D, world, friction_row);
    f_loss = wp::index(problem.frictionloss, world, friction_row);
    f_jar = acc - wp::index(problem.aref, world, friction_row);
    f_edge = over(f_loss, f_D);
}
vec[lane] = acc;

// ---- all other rows: dense Jacobian, and what each row is
#pragma unroll 1
for (int k = lane; k < rows * STRIDE; k += 32) J[k] = 0.0f;
sync();
const int nacon = wp::index(problem.nacon, 0);
#pragma unroll 1
for (int k = lane; k < rows; k += 32) {
    const int row = row_of(k);
    const int nnz = wp::index(problem.J_rownnz, world, row), adr = wp::index(problem.J_rowadr, world, row);
    float product = 0.0f;
#pragma unroll 1
    for (int e = 0; e < nnz; ++e) {
        const int col = wp::index(problem.J_colind, world, 0, adr + e);
        const float value = wp::index(problem.J, world, 0, adr + e);
        J[k * STRIDE + col] = value;
        product += value * vec[col];
    }
    jar[k] = product - wp::index(problem.aref, world, row);
    D[k] = wp::index(problem.D, world, row);
    state[k] = SATISFIED;
    force[k] = 0.0f;
    int what = 1;
    if (wp::index(problem.type, world, row) == CONTACT_ELLIPTIC) {
        const int contact = wp::index(problem.id, world, row);
        what = 0;
        if (contact < nacon) {
            const int first = wp::index(problem.contact_efc_address, contact, 0);
            const int place = row - first;
            if (place == 0) {
                const int dim = wp::index(problem.contact_dim, contact);
                what = dim <= rows - k ? dim : 0;  // one that njmax cut: no force, as in MuJoCo-Warp
            }
            const float* friction = (const float*)&wp::index(problem.contact_friction, contact);
            scale[k] = place == 0 ? friction[0] * invsqrt : (place > 0 && place < 6 ? friction[place - 1] : 0.0f);
        }
    }
    kind[k] = what;
}
sync();
int items = 0;
#pragma unroll 1
for (int base = 0; base < rows; base += 32) {
    const int k = base + lane;
    const bool first = k < rows && kind[k] > 0;
    const unsigned all = ballot(first);
    if (first) item[items + ones(all & ((1u << lane) - 1u))] = k;
    items += ones(all);
}
sync();

auto times_M = [&]() {  // M times vec, this lane's entry
    float out = 0.0f;
    for (int i = 0; i < NV; ++i) out += M[i] * vec[i];
    return mine ? out : 0.0f;
};
float Ma = times_M();

float grad = 0.0f, constraint = 0.0f, search = 0.0f, search_dot = 0.0f, decrement = 0.0f;
float f_force = 0.0f;
int f_state = SATISFIED;
