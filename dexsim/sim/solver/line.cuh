// Part 3 of 3: the search along a direction, the loop of Newton's iterations around it, and what is left behind.
// Formulas and decisions: mujoco_warp's _linesearch_iterative_kernel and _solve_done.

struct Point { float cost, slope, curve; };  // of the cost along the search direction, less the cost at its start

// ---- one row of dry friction
auto dry_cost = [&](float x) {
    if (-f_edge < x && x < f_edge) return 0.5f * f_D * x * x;
    return x <= -f_edge ? f_loss * (-0.5f * f_edge - x) : f_loss * (-0.5f * f_edge + x);
};
auto dry_point = [&](float x) {
    if (-f_edge < x && x < f_edge) {
        const float jD = search * f_D;
        return Point{0.5f * f_D * x * x, jD * x, search * jD};
    }
    if (x <= -f_edge) return Point{f_loss * (-0.5f * f_edge - x), -f_loss * search, 0.0f};
    return Point{f_loss * (-0.5f * f_edge + x), f_loss * search, 0.0f};
};

// ---- one contact: quad is its quadratic, (u0, v0) its normal and (u_par, v_norm, u_perp2) its tangent's line
struct Cone { float mu, a, b, c, u0, v0, perp, par, norm, dm, cost0, T0, r0; int state0; };
auto cone_of = [&](int k) {
    Cone o;
    o.mu = scale[k];
    o.a = q0[k]; o.b = q1[k]; o.c = q2[k];
    o.u0 = q0[k + 1]; o.v0 = q1[k + 1]; o.perp = q2[k + 1];
    o.par = q0[k + 2]; o.norm = q1[k + 2]; o.dm = q2[k + 2];
    o.cost0 = 0.0f; o.T0 = 0.0f; o.r0 = 0.0f; o.state0 = SATISFIED;
    const float uu = o.par * o.par + o.perp;
    if (uu <= 0.0f) {
        if (o.u0 < 0.0f) { o.cost0 = o.a; o.state0 = QUADRATIC; }
        return o;
    }
    o.T0 = sqrtf(uu);
    if (o.u0 >= o.mu * o.T0) return o;
    if (o.mu * o.u0 + o.T0 <= 0.0f) { o.cost0 = o.a; o.state0 = QUADRATIC; return o; }
    o.r0 = o.u0 - o.mu * o.T0;
    o.cost0 = 0.5f * o.dm * o.r0 * o.r0;
    o.state0 = CONE;
    return o;
};
auto cone_quadratic = [&](const Cone& o, float alpha, float N, float TT) {
    const float step = alpha * o.c;
    float cost = alpha * (step + o.b);
    if (o.state0 == CONE) {
        const float edge = o.mu * o.u0 + o.T0;
        cost += 0.5f * o.dm * edge * edge;
    } else if (o.state0 == SATISFIED) {
        cost = 0.5f * o.dm * (1.0f + o.mu * o.mu) * (N * N + larger(TT, 0.0f));
    }
    return Point{cost, 2.0f * step + o.b, 2.0f * o.c};
};
auto cone_point = [&](const Cone& o, float alpha) {
    const float N = o.u0 + alpha * o.v0, w = o.par + alpha * o.norm, TT = w * w + o.perp;
    if (TT <= 0.0f) {
        if (N < 0.0f) return cone_quadratic(o, alpha, N, TT);
        return Point{-o.cost0, 0.0f, 0.0f};
    }
    const float T = sqrtf(TT);
    if (N >= o.mu * T) return Point{-o.cost0, 0.0f, 0.0f};
    if (o.mu * N + T <= 0.0f) return cone_quadratic(o, alpha, N, TT);
    const float inv = 1.0f / T;
    const float T1 = w * o.norm * inv, T2 = (o.perp / TT) * (o.norm * o.norm * inv);
    const float r = N - o.mu * T, r1 = o.v0 - o.mu * T1;
    float cost;
    if (o.state0 == CONE) {  // T - T0 without cancellation
        const float dT = alpha * o.norm * (o.par + w) / (T + o.T0);
        const float dr = alpha * o.v0 - o.mu * dT;
        cost = 0.5f * o.dm * dr * (2.0f * o.r0 + dr);
    } else if (o.state0 == QUADRATIC) {
        const float edge = o.mu * N + T;
        cost = alpha * (alpha * o.c + o.b) - 0.5f * o.dm * edge * edge;
    } else {
        cost = 0.5f * o.dm * r * r;
    }
    return Point{cost, o.dm * r * r1, o.dm * (r1 * r1 + r * (-o.mu * T2))};
};
auto single_point = [&](int k, float alpha) {  // an equality, a limit, or a contact without friction
    const float a = jar[k], v = jv[k], d = D[k];
    const float quad0 = 0.5f * d * a * a, cost0 = k < ne || a < 0.0f ? quad0 : 0.0f;
    if (k < ne || a + alpha * v < 0.0f) {
        const float vD = v * d, curve = v * vD, ah = alpha * curve;
        return Point{alpha * (vD * a + 0.5f * ah) + (quad0 - cost0), vD * a + ah, curve};
    }
    return Point{-cost0, 0.0f, 0.0f};
};

// ---- Newton's iterations. The first pass has no line to search: one loop, so that its code is there once
int iteration = 0, overflow = 0;
float alpha = 0.0f, improvement = 0.0f;
for (;; ++iteration) {
    if (iteration) {
        vec[lane] = search;
        sync();
        const float mv = times_M();
#pragma unroll 1
        for (int k = lane; k < rows; k += 32) {
            const float* row = J + k * STRIDE;
            float out = 0.0f;
#pragma unroll
            for (int i = 0; i + 4 <= NV; i += 4) {
#if defined(__CUDA_ARCH__)
                const float4 v = *(const float4*)(row + i);
                const float4 s = *(const float4*)(vec + i);
                out += v.x * s.x; out += v.y * s.y; out += v.z * s.z; out += v.w * s.w;
#else
                for (int c = 0; c < 4; ++c) out += row[i + c] * vec[i + c];
#endif
            }
#pragma unroll
            for (int i = NV & ~3; i < NV; ++i) out += row[i] * vec[i];
            jv[k] = out;
        }
        sync();

        // quadratics of the contacts, and everything at alpha = 0
        float p_cost = 0.0f, p_slope = 0.0f, p_curve = 0.0f;
#pragma unroll 1
        for (int i = lane; i < items; i += 32) {
            const int k = item[i], dim = kind[k];
            if (dim == 1) {
                if (k < ne || jar[k] < 0.0f) {
                    const float vD = jv[k] * D[k];
                    p_cost += 0.5f * D[k] * jar[k] * jar[k];
                    p_slope += vD * jar[k];
                    p_curve += jv[k] * vD;
                }
                continue;
            }
            const float mu = scale[k];
            float a = 0.5f * jar[k] * jar[k] * D[k], b = jv[k] * D[k] * jar[k], c = 0.5f * jv[k] * jv[k] * D[k];
            float uu = 0.0f, uv = 0.0f, vv = 0.0f, det = 0.0f;
#pragma unroll 1
            for (int j = 1; j < dim; ++j) {
                const float uj = jar[k + j] * scale[k + j], vj = jv[k + j] * scale[k + j];
                const float DJ = D[k + j] * jar[k + j];
                a += 0.5f * jar[k + j] * DJ;
                b += jv[k + j] * DJ;
                c += 0.5f * jv[k + j] * D[k + j] * jv[k + j];
#pragma unroll 1
                for (int n = 1; n < j; ++n) {
                    const float cross = uj * jv[k + n] * scale[k + n] - jar[k + n] * scale[k + n] * vj;
                    det += cross * cross;
                }
                uu += uj * uj;
                uv += uj * vj;
                vv += vj * vj;
            }
            float norm = 0.0f, par = 0.0f, perp = uu;
            if (vv > 0.0f) {
                norm = sqrtf(vv);
                par = uv / norm;
                perp = det / vv;
            }
            q0[k] = a; q1[k] = b; q2[k] = c;
            q0[k + 1] = jar[k] * mu; q1[k + 1] = jv[k] * mu; q2[k + 1] = perp;
            q0[k + 2] = par; q1[k + 2] = norm; q2[k + 2] = D[k] / (mu * mu * (1.0f + mu * mu));
            const Cone o = cone_of(k);
            if (o.state0 == QUADRATIC) {
                p_cost += a; p_slope += b; p_curve += 2.0f * c;
            } else if (o.state0 == CONE) {
                const float inv = 1.0f / o.T0;
                const float T1 = par * norm * inv, T2 = (perp / (o.T0 * o.T0)) * (norm * norm * inv);
                const float r1 = o.v0 - mu * T1;
                p_cost += o.cost0;
                p_slope += o.dm * o.r0 * r1;
                p_curve += o.dm * (r1 * r1 - mu * o.r0 * T2);
            }
        }
        float dry_cost0 = 0.0f;
        if (dry) {
            const Point p = dry_point(f_jar);
            dry_cost0 = dry_cost(f_jar);
            p_cost += p.cost; p_slope += p.slope; p_curve += p.curve;
        }
        // the smooth part's line
        const float g1 = total(search * (Ma - smooth)), g2 = total(0.5f * search * mv);
        p_cost = total(p_cost);
        p_slope = total(p_slope);
        p_curve = total(p_curve);

        auto evaluate = [&](float alpha) {  // this lane's share
            Point sum{0.0f, 0.0f, 0.0f};
#pragma unroll 1
            for (int i = lane; i < items; i += 32) {
                const int k = item[i];
                const Point p = kind[k] == 1 ? single_point(k, alpha) : cone_point(cone_of(k), alpha);
                sum.cost += p.cost; sum.slope += p.slope; sum.curve += p.curve;
            }
            if (dry) {
                const Point p = dry_point(f_jar + alpha * search);
                sum.cost += p.cost - dry_cost0; sum.slope += p.slope; sum.curve += p.curve;
            }
            return sum;
        };
        auto whole = [&](Point p, float alpha) {  // of all lanes, with the smooth part
            const float step = alpha * g2;
            p.cost = total(p.cost) + alpha * step + alpha * g1;
            p.slope = total(p.slope) + 2.0f * step + g1;
            p.curve = total(p.curve) + 2.0f * g2;
            return p;
        };

        const Point p0{0.0f, p_slope + g1, p_curve + 2.0f * g2};
        const float gross = sqrtf(2.0f * larger(p_cost, 0.0f) * larger(p_curve, 0.0f)) + fabsf(g1);
        const float gtol = larger(tolerance * ls_tolerance * sqrtf(search_dot) / inertia_scale, 1e-6f);
        const float accept = larger(gtol, NOISE * gross);
        alpha = improvement = 0.0f;
        bool found = fabsf(p0.slope) < NOISE * gross;
        // n = -1 is the Newton step from alpha = 0; after it both ends of the bracket make one, and it is halved
        Point lo = p0, hi = p0;
        float lo_alpha = 0.0f, hi_alpha = 0.0f;
        auto nearer = [](const Point& x, const Point& y) {
            return (x.slope < y.slope && y.slope < 0.0f) || (x.slope > y.slope && y.slope > 0.0f);
        };
#pragma unroll 1
        for (int n = -1; n < ls_iterations && !found; ++n) {
            const float lo_next_alpha = lo_alpha - over(lo.slope, lo.curve);
            const float hi_next_alpha = hi_alpha - over(hi.slope, hi.curve);
            const float mid_alpha = 0.5f * (lo_alpha + hi_alpha);
            Point lo_next = p0, hi_next = p0, mid = p0;
#pragma unroll 1
            for (int c = 0; c < (n < 0 ? 1 : 3); ++c) {
                const float at = c == 0 ? lo_next_alpha : (c == 1 ? hi_next_alpha : mid_alpha);
                const Point p = whole(evaluate(at), at);
                if (c == 0) lo_next = p;
                else if (c == 1) hi_next = p;
                else mid = p;
            }
            const bool at_lo = fabsf(lo_next.slope) < accept && lo_next.cost < 0.0f;
            if (n < 0) {
                if (at_lo) {
                    found = true;
                    alpha = lo_next_alpha;
                    improvement = -lo_next.cost;
                } else if (lo_next.slope < p0.slope) {
                    lo = lo_next; lo_alpha = lo_next_alpha;
                } else {
                    hi = lo_next; hi_alpha = lo_next_alpha;
                }
                continue;
            }
            const bool at_hi = fabsf(hi_next.slope) < accept && hi_next.cost < 0.0f;
            const bool at_mid = fabsf(mid.slope) < accept && mid.cost < 0.0f;
            const bool converged = at_lo || at_hi || at_mid;
            bool moved_lo = false, moved_hi = false;
            if (converged) {
                Point best{1e10f, 0.0f, 0.0f};
                float best_alpha = 0.0f;
                if (at_lo && lo_next.cost < best.cost) { best = lo_next; best_alpha = lo_next_alpha; }
                if (at_hi && hi_next.cost < best.cost) { best = hi_next; best_alpha = hi_next_alpha; }
                if (at_mid && mid.cost < best.cost) { best = mid; best_alpha = mid_alpha; }
                lo = hi = best;
                lo_alpha = hi_alpha = best_alpha;
            } else {
                if (nearer(lo, lo_next)) { lo = lo_next; lo_alpha = lo_next_alpha; moved_lo = true; }
                if (nearer(lo, mid)) { lo = mid; lo_alpha = mid_alpha; moved_lo = true; }
                if (nearer(lo, hi_next)) { lo = hi_next; lo_alpha = hi_next_alpha; moved_lo = true; }
                if (nearer(hi, hi_next) || (hi.slope < 0.0f && hi_next.slope > 0.0f)) {
                    hi = hi_next; hi_alpha = hi_next_alpha; moved_hi = true;
                }
                if (nearer(hi, mid)) { hi = mid; hi_alpha = mid_alpha; moved_hi = true; }
                if (nearer(hi, lo_next)) { hi = lo_next; hi_alpha = lo_next_alpha; moved_hi = true; }
            }
            if (lo.cost < 0.0f || hi.cost < 0.0f) {
                const bool lower = lo.cost < hi.cost;
                alpha = lower ? lo_alpha : hi_alpha;
                improvement = -(lower ? lo.cost : hi.cost);
            }
            found = converged || (!moved_lo && !moved_hi) || (lo.cost < 0.0f && lo.slope < 0.0f && lo.slope > -gtol) ||
                (hi.cost < 0.0f && hi.slope > 0.0f && hi.slope < gtol);
        }
        if (!found) overflow |= LS_OVERFLOW;

        sync();  // all have read jar
        acc += alpha * search;
        Ma += alpha * mv;
        f_jar += alpha * search;
#pragma unroll 1
        for (int k = lane; k < rows; k += 32) jar[k] += alpha * jv[k];
        sync();
    }
    update_constraint();
    const float grad_dot = update_gradient();
    if (iteration) {
        const float improved = inertia_scale * improvement;
        if (alpha == 0.0f || (improved > 0.0f && improved < tolerance) ||
            inertia_scale * sqrtf(grad_dot) < tolerance) break;
    }
    update_search();  // what follows is for the next iteration, and for the last criterion
    if (iteration) {
        if (inertia_scale * 0.5f * decrement < tolerance) break;
        if (iteration >= iterations) {
            overflow |= ITERATIONS_OVERFLOW;
            break;
        }
    }
}

if (mine) {
    wp::index(solution.qacc, world, lane) = acc;
    wp::index(solution.Ma, world, lane) = Ma;
    wp::index(solution.qfrc_constraint, world, lane) = constraint;
}
if (dry) {
    wp::index(solution.force, world, friction_row) = f_force;
    wp::index(solution.state, world, friction_row) = f_state;
}
#pragma unroll 1
for (int k = lane; k < rows; k += 32) {
    wp::index(solution.force, world, row_of(k)) = force[k];
    wp::index(solution.state, world, row_of(k)) = state[k];
}
if (lane == 0) {
    wp::index(solution.niter, world) = iteration;
    if (overflow) wp::index(solution.overflow, world) |= overflow;
}
