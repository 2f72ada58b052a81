// Part 2 of 3: forces at a point, gradient, Hessian and Newton direction. Formulas: mujoco_warp's _eval_constraint and
// _elliptic_hessian_entry_from_projections.

// ---- forces and states of all rows at jar
auto update_constraint = [&]() {
    if (dry) {
        if (f_jar <= -f_edge) { f_force = f_loss; f_state = LINEARNEG; }
        else if (f_jar >= f_edge) { f_force = -f_loss; f_state = LINEARPOS; }
        else { f_force = -f_D * f_jar; f_state = QUADRATIC; }
    }
#pragma unroll 1
    for (int i = lane; i < items; i += 32) {
        const int k = item[i], dim = kind[k];
        if (dim == 1) {
            const bool on = k < ne || jar[k] < 0.0f;
            force[k] = on ? -D[k] * jar[k] : 0.0f;
            state[k] = on ? QUADRATIC : SATISFIED;
            continue;
        }
        const float mu = scale[k], N = jar[k] * mu;
        float TT = 0.0f;
#pragma unroll 1
        for (int j = 1; j < dim; ++j) {
            const float u = jar[k + j] * scale[k + j];
            TT += u * u;
        }
        const float T = TT <= 0.0f ? 0.0f : sqrtf(TT);
        int now = CONE;
        if (N >= mu * T || (T <= 0.0f && N >= 0.0f)) {
            now = SATISFIED;
            for (int j = 0; j < dim; ++j) force[k + j] = 0.0f;
        } else if (mu * N + T <= 0.0f || (T <= 0.0f && N < 0.0f)) {
            now = QUADRATIC;
#pragma unroll 1
            for (int j = 0; j < dim; ++j) force[k + j] = -D[k + j] * jar[k + j];
        } else {
            const float dm = over(D[k], mu * mu * (1.0f + mu * mu));
            const float normal = -dm * (N - mu * T) * mu;
            const float tangent = -over(normal, T);
            force[k] = normal;
#pragma unroll 1
            for (int j = 1; j < dim; ++j) force[k + j] = tangent * jar[k + j] * scale[k + j] * scale[k + j];
        }
#pragma unroll 1
        for (int j = 0; j < dim; ++j) state[k + j] = now;
    }
    sync();
};

// ---- gradient; its squared norm is returned
auto update_gradient = [&]() {
    constraint = f_force;
    if (mine)
#pragma unroll 4
        for (int k = 0; k < rows; ++k) constraint += J[k * STRIDE + lane] * force[k];
    grad = mine ? Ma - smooth - constraint : 0.0f;
    return total(grad * grad);
};

// ---- Hessian, its Cholesky factor, and the Newton direction
auto update_search = [&]() {
    float h[NV];
    for (int i = 0; i < NV; ++i) h[i] = M[i] + (lane == i && f_state == QUADRATIC && dry ? f_D : 0.0f);
    auto add = [&](int k, float w) {  // h += J[k] w, w being this lane's
        const float* row = J + k * STRIDE;
#pragma unroll
        for (int i = 0; i + 4 <= NV; i += 4) {
#if defined(__CUDA_ARCH__)
            const float4 v = *(const float4*)(row + i);
            h[i] += v.x * w; h[i + 1] += v.y * w; h[i + 2] += v.z * w; h[i + 3] += v.w * w;
#else
            for (int c = 0; c < 4; ++c) h[i + c] += row[i + c] * w;
#endif
        }
#pragma unroll
        for (int i = NV & ~3; i < NV; ++i) h[i] += row[i] * w;
    };
    const int col = mine ? lane : 0;
#pragma unroll 1
    for (int n = 0; n < items; ++n) {
        const int k = item[n], dim = kind[k], now = state[k];
        if (now != QUADRATIC && now != CONE) continue;
        float normal = 0.0f, mixed = 0.0f, rest = 0.0f, dm = 0.0f, inv_t = 0.0f;
        if (now == CONE) {
            const float mu = scale[k], mu2 = mu * mu;
            dm = over(D[k], mu2 * (1.0f + mu2));
            float tt = 0.0f, along = 0.0f;
#pragma unroll 1
            for (int j = 1; j < dim; ++j) {
                const float u = jar[k + j] * scale[k + j];
                tt += u * u;
                along += u * scale[k + j] * J[(k + j) * STRIDE + col];
            }
            inv_t = 1.0f / larger(sqrtf(tt), TINY);
            along *= inv_t;  // along the unit tangent
            const float ratio = mu * (jar[k] * mu) * inv_t, z0 = mu * J[k * STRIDE + col];
            rest = mu2 - ratio;
            mixed = ratio * along - mu * z0;
            normal = dm * mu * (z0 - mu * along);
        }
#pragma unroll 1
        for (int j = 0; j < dim; ++j) {
            const float z = J[(k + j) * STRIDE + col];
            float w = D[k + j] * z;
            if (now == CONE) {
                const float s = scale[k + j];
                w = j ? dm * s * (jar[k + j] * s * inv_t * mixed + rest * (s * z)) : normal;
            }
            add(k + j, w);
        }
    }
    // H = U' U, lane j holding column j of U; the forward substitution goes along
    float g = grad, y = 0.0f;
#pragma unroll
    for (int k = 0; k < NV; ++k) {
        const float inv = 1.0f / sqrtf(from(h[k], k));
        const float u = h[k] * inv;
        const float yk = from(g, k) * inv;
        if (lane > k) g -= u * yk;
        if (lane == k) y = yk * inv;
        if (mine) upper[k * US + lane] = u * inv;  // rows divided by their diagonal
#pragma unroll
        for (int i = k + 1; i < NV; ++i) h[i] -= from(u, i) * u;
    }
    sync();
    const float* row = upper + (mine ? lane : 0) * US;
#pragma unroll
    for (int j = NV - 1; j > 0; --j) {
        const float x = from(y, j);
        if (lane < j) y -= row[j] * x;
    }
    y = mine ? y : 0.0f;
    search_dot = total(y * y);
    decrement = total(grad * y);
    search = -y;
    sync();
};
