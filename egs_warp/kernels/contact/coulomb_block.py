"""Block-cooperative routines of the Coulomb solve on a GPU: products, sweeps and residual (see
``kernels.contact.coulomb``).

The routines compute the same sums as one thread on a CPU, in a different order, and are not called on a CPU. All
``BLOCK`` threads of a block call each routine; afterwards, its results are visible to all of them.
"""

import warp as wp

from egs_warp.kernels.locomotion.block_algebra import by_block
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""Number of threads for each problem on a GPU."""
MAX_SWEPT_CONTACTS = 128
"""Maximum number of contacts of ``sweep_by_block``."""
SHARED_MEMORY_DOUBLES = 5264
"""Size of the shared memory of a block, in doubles. The routines use it one after the other."""

_RECIPROCALS = """
    // Reciprocal and reciprocal square root up to rounding, for normal numbers only.
    auto over = [](double value) {
        double by;
        asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(by) : "d"(value));
        const double error = fma(-value, by, 1.0);
        return fma(by, fma(error, error, error), by);
    };
    auto over_root = [](double value) {
        double by;
        asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(by) : "d"(value));
        const double error = fma(-value, by * by, 1.0);
        return fma(fma(0.375, error, 0.5), by * error, by);
    };
    (void)over, (void)over_root;
"""


def gpu_or_cpu(body: str, *, otherwise: str = "") -> str:
    """Return native code that runs ``body`` on a GPU and ``otherwise`` on a CPU, where the code is compiled but never
    called."""
    sizes = f"MAX_SWEPT = {MAX_SWEPT_CONTACTS}, SHARED_DOUBLES = {SHARED_MEMORY_DOUBLES}"
    definitions = f"{_RECIPROCALS}    constexpr int WARPS = {BLOCK // 32}, {sizes};\n"
    definitions += "    (void)WARPS, (void)MAX_SWEPT, (void)SHARED_DOUBLES;\n"
    return by_block(f"#if defined(__CUDA_ARCH__)\n{definitions}{body}\n#else\n{otherwise}\n#endif\n")


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 1;
#else
    return 0;
#endif
""")
def is_gpu() -> int:
    """Return 1 on a GPU, 0 on a CPU. The result is a compile-time constant, so branches for the other device are
    dropped."""
    ...


@wp.func_native(
    gpu_or_cpu(
        """
    __shared__ __align__(16) double memory[SHARED_DOUBLES];
    return static_cast<unsigned>(__cvta_generic_to_shared(memory));
""",
        otherwise="    return 0;",
    )
)
def shared_memory() -> wp.uint32:
    """Return the address of ``SHARED_MEMORY_DOUBLES`` doubles in the shared memory of the block."""
    ...


@wp.func_native(
    gpu_or_cpu("""
    // Eight threads share a row, so a warp has four rows.
    const double *const G = delassus.data, *const x = forces.data;
    const int stride = delassus.strides[0] / 8, place = own & 7, part = own >> 3;
    for (int first = 4 * warp; first < size; first += 4 * WARPS) {
        const int row = first + part < size ? first + part : size - 1;
        const double* const g = G + row * stride;
        double sum = 0.0, other = 0.0;
        #pragma unroll 1
        for (int c = place; c < size; c += 64) {
            double left[8], right[8];
            #pragma unroll
            for (int t = 0; t < 8; ++t) {
                const bool there = c + 8 * t < size;
                left[t] = there ? g[c + 8 * t] : 0.0;
                right[t] = there ? x[c + 8 * t] : 0.0;
            }
            #pragma unroll
            for (int t = 0; t < 8; t += 2) {
                sum += left[t] * right[t];
                other += left[t + 1] * right[t + 1];
            }
        }
        sum += other;
        for (int away = 4; away > 0; away >>= 1) sum += __shfl_xor_sync(0xffffffffu, sum, away);
        if (place == 0 && first + part < size) speeds.data[row] = sum;
    }
    WAIT;
""")
)
def speeds_by_block(delassus: wp.array2d[real], size: int, forces: wp.array[real], speeds: wp.array[real]) -> None:
    """Compute G f, the contact velocities in m/s that the contact forces f in newtons cause.

    Args:
        delassus: G (size, size) m/(N s).
        size: number of force components.
        forces: (size,) newtons, f.
        speeds: (size,) m/s, output.
    """
    ...


@wp.func_native(
    gpu_or_cpu("""
    // The first warp updates the forces of a group of contacts in turn. Meanwhile the other warps compute the
    // velocities at the next group, to which the first warp adds the effect of its own changes, and load the entries
    // it needs there.
    constexpr int GROUP = 5, ROWS = 3 * GROUP, PITCH = 17;
    double* const all = (double*)__cvta_shared_to_generic(shared_address);
    double (*const fresh)[16] = (double (*)[16])(all + 3 * MAX_SWEPT), (*const speeds)[16] = fresh + 2;
    double (*const window)[2 * ROWS * PITCH] = (double (*)[2 * ROWS * PITCH])(speeds + 2);
    double (*const by)[4] = (double (*)[4])(window + 2);
    static_assert(7 * MAX_SWEPT + 4 * (16 + ROWS * PITCH) <= SHARED_DOUBLES, "");
    const int size = 3 * count, groups = (count + GROUP - 1) / GROUP, turns = sweeps * groups;
    const int stride = delassus.strides[0] / 8;
    const double* const G = delassus.data;
    for (int k = lane; k < size; k += lanes) all[k] = forces.data[k];
    for (int i = lane; i < count; i += lanes) {
        const double* const d = G + 3 * i * stride + 3 * i;
        const double soft = over(fmax(d[stride + 1], d[2 * stride + 2]));
        by[i][0] = over(d[0]);
        by[i][1] = soft;
        by[i][2] = d[stride] * soft;
        by[i][3] = d[2 * stride] * soft;
    }
    WAIT;
    double moved = 0.0;
    int group = -1;
    for (int turn = -1; turn < turns; ++turn) {
        const int now = turn & 1, next = now ^ 1, ahead = group + 1 < groups ? group + 1 : 0;
        const int before = turn > 0 ? ROWS * (group > 0 ? group - 1 : groups - 1) : -ROWS;
        if (warp == 0) {
            if (turn >= 0) {
                // Each thread holds the velocity of a row of this group or the next; all compute the same force.
                const int some = count - GROUP * group < GROUP ? count - GROUP * group : GROUP;
                const double *const f = groups == 1 && turn > 0 ? fresh[next] : all + ROWS * group;
                const double *const b = by[GROUP * group];
                const double *const w = window[now] + (own < 2 * ROWS ? own : 2 * ROWS - 1) * PITCH;
                double speed = own < ROWS ? moved + speeds[now][own] : moved;
                double f0 = f[0], f1 = f[1], f2 = f[2], w0 = w[0], w1 = w[1], w2 = w[2];
                double b0 = b[0], b1 = b[1], b2 = b[2], b3 = b[3];
                #pragma unroll 1
                for (int i = 0; i < some; ++i) {
                    const int n = 3 * i, then = i + 1 < some ? i + 1 : i;
                    const double u0 = __shfl_sync(0xffffffffu, speed, n), u1 = __shfl_sync(0xffffffffu, speed, n + 1);
                    const double u2 = __shfl_sync(0xffffffffu, speed, n + 2);
                    const double *const ff = f + 3 * then, *const ww = w + 3 * then, *const bb = b + 4 * then;
                    const double next_f0 = ff[0], next_f1 = ff[1], next_f2 = ff[2];
                    const double next_w0 = ww[0], next_w1 = ww[1], next_w2 = ww[2];
                    const double next_b0 = bb[0], next_b1 = bb[1], next_b2 = bb[2], next_b3 = bb[3];
                    double normal = f0 - u0 * b0;
                    if (__double2hiint(normal) < 0) normal = 0.0;
                    const double one = (f1 - u1 * b1 + b2 * f0) - b2 * normal;
                    const double two = (f2 - u2 * b1 + b3 * f0) - b3 * normal;
                    const double square = one * one + two * two, radius = friction * normal;
                    const double share = square > radius * radius ? radius * over_root(square) : 1.0;
                    const double rest = speed + w0 * (normal - f0) - (w1 * f1 + w2 * f2);
                    speed = rest + share * (w1 * one + w2 * two);
                    if (own < 3) fresh[now][n + own] = own == 0 ? normal : share * (own == 1 ? one : two);
                    f0 = next_f0, f1 = next_f1, f2 = next_f2, w0 = next_w0, w1 = next_w1, w2 = next_w2;
                    b0 = next_b0, b1 = next_b1, b2 = next_b2, b3 = next_b3;
                }
                moved = __shfl_down_sync(0xffffffffu, speed, ROWS);
                if (own >= ROWS) moved = 0.0;
            }
        } else if (turn + 1 < turns) {
            const int start = ROWS * ahead, after = ROWS * (ahead + 1 < groups ? ahead + 1 : 0), half = own & 15;
            for (int r = 2 * (warp - 1) + (own >> 4); r < 16; r += 2 * (WARPS - 1)) {
                const int row = start + r < size ? start + r : size - 1;
                double sum = 0.0;
                #pragma unroll 4
                for (int c = half; c < size; c += 16)
                    sum += G[row * stride + c] * (c >= before && c < before + ROWS ? fresh[next][c - before] : all[c]);
                for (int away = 8; away > 0; away >>= 1) sum += __shfl_xor_sync(0xffffffffu, sum, away);
                if (half == 0) speeds[next][r] = sum + free.data[row] + (row % 3 == 0 ? shifts.data[row / 3] : 0.0);
            }
            for (int e = lane - 32; e < 2 * ROWS * 16; e += lanes - 32) {
                const int r = e >> 4, c = start + (e & 15), row = r < ROWS ? start + r : after + r - ROWS;
                window[next][r * PITCH + (e & 15)] = row < size && c < size ? G[row * stride + c] : 0.0;
            }
            if (warp == WARPS - 1 && before >= 0 && own < ROWS && before + own < size)
                all[before + own] = fresh[next][own];
        }
        WAIT;
        group = ahead;
    }
    // The forces of the last two groups have not been written to all yet.
    const int last = (turns - 1) % groups, other = turns > 1 ? (turns - 2) % groups : -1;
    for (int k = lane; k < size; k += lanes) {
        const int mine = k / ROWS, r = k - ROWS * mine;
        forces.data[k] = mine == last ? fresh[(turns - 1) & 1][r] : mine == other ? fresh[turns & 1][r] : all[k];
    }
    WAIT;
""")
)
def sweep_by_block(
    shared_address: wp.uint32,
    delassus: wp.array2d[real],
    free: wp.array[real],
    shifts: wp.array[real],
    friction: real,
    count: int,
    sweeps: int,
    forces: wp.array[real],
) -> None:
    """Perform ``sweeps`` Gauss-Seidel sweeps on a problem with at most ``MAX_SWEPT_CONTACTS`` contacts, as ``sweep``
    does.

    Args:
        shared_address: result of ``shared_memory``.
        delassus: (3n, 3n) m/(N s), Delassus operator.
        free: (3n,) m/s, contact velocities without contact forces.
        shifts: (n,) m/s, bias of the normal velocities.
        friction: Coulomb coefficient.
        count: number n of contacts, at least 1.
        sweeps: number of sweeps.
        forces: (3n,) newtons, updated in place.
    """
    ...


@wp.func_native(
    gpu_or_cpu(
        """
    __shared__ double parts[2][WARPS];
    const double *const G = delassus.data, *const f = forces.data, *const u = velocities.data;
    const double *const s = step.data, *const v = change.data;
    const int stride = delassus.strides[0] / 8;
    const double third = over(3.0 * scale);
    double most = 0.0, square = 0.0;
    for (int i = lane; i < count; i += lanes) {
        const int n = 3 * i;
        const double* const d = G + n * stride + n;
        const double trace = d[0] + d[stride + 1] + d[2 * stride + 2], rate = 3.0 * scale * over(trace);
        const double speed = trace * third;
        const double normal = f[n] + length * s[n];
        const double f1 = f[n + 1] + length * s[n + 1], f2 = f[n + 2] + length * s[n + 2];
        const double trial = normal - rate * (u[n] + length * v[n]);
        const double first = f1 - rate * (u[n + 1] + length * v[n + 1]);
        const double second = f2 - rate * (u[n + 2] + length * v[n + 2]);
        const double radius = friction * fmax(normal, 0.0), pull = first * first + second * second;
        const double share = pull > radius * radius ? radius * over_root(pull) : 1.0;
        const double a = normal - fmax(trial, 0.0), b = f1 - share * first, c = f2 - share * second;
        values.data[n] = a;
        values.data[n + 1] = b;
        values.data[n + 2] = c;
        most = fmax(most, speed * fmax(fabs(a), fmax(fabs(b), fabs(c))));
        // The maximum ignores NaN; the sum of squares does not.
        square += speed * speed * (a * a + b * b + c * c) + 0.0 * trial;
    }
    if (32 * warp < count) {
        #pragma unroll 1
        for (int away = 16; away > 0; away >>= 1) {
            most = fmax(most, __shfl_xor_sync(0xffffffffu, most, away));
            square += __shfl_xor_sync(0xffffffffu, square, away);
        }
        if (own == 0) {
            parts[0][warp] = most;
            parts[1][warp] = square;
        }
    }
    WAIT;
    most = parts[0][0];
    square = parts[1][0];
    for (int i = 1; i < WARPS && 32 * i < count; ++i) {
        most = fmax(most, parts[0][i]);
        square += parts[1][i];
    }
    // All threads must have read parts before the next call writes them.
    WAIT;
    if (count == 0) most = square = 0.0;
    if (!(square < INFINITY)) most = INFINITY;
    return wp::vec_t<2, double>(most, wp::sqrt(square));
""",
        otherwise="    return wp::vec_t<2, double>(0.0, 0.0);",
    )
)
def residual_by_block(
    delassus: wp.array2d[real],
    friction: real,
    count: int,
    forces: wp.array[real],
    velocities: wp.array[real],
    step: wp.array[real],
    change: wp.array[real],
    scale: real,
    length: real,
    values: wp.array[real],
) -> wp.vec2d:
    """Evaluate the projection equations, as ``projection_residual`` does, at the fraction ``length`` of a Newton step.

    Args:
        delassus: (3n, 3n) m/(N s), Delassus operator.
        friction: Coulomb coefficient.
        count: number n of contacts.
        forces: (3n,) newtons, forces at the start of the step.
        velocities: (3n,) m/s, contact velocities at the start of the step, including the normal bias.
        step: (3n,) newtons, full step.
        change: (3n,) m/s, change of the velocities in the full step.
        scale: scale of the projection rates (``rate_of``).
        length: fraction of the step.
        values: (3n,) newtons, output: the residual of the equations.

    Returns:
        Largest magnitude and Euclidean norm of the residual, divided by the projection rates, m/s.
    """
    ...
