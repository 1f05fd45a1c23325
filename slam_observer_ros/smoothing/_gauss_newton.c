/* Gauss-Newton in C: what gauss_newton.py and bordered_chain.py do of maps of points.
 *
 * linearise() fills in the normal equations: what a prior says, what motions and what observed
 * points do. eliminate() takes all poses but the border out of them, and fill_in() finds the
 * changes of the poses from that of the border. What the equations mean, and the units, those two
 * modules say; a change is made in both, and test/smoothing/test_compiled.py holds each to the
 * other. Arrays are checked as they come in, by the functions named read_..., and nothing is after
 * them. Other threads run meanwhile: the equations are those of the caller alone. */
#include "../filter/_door.h" /* first, as it includes Python.h */
#include "../filter/_se3.h"

enum { STRIDE = 8, INNER = STRIDE - 1 }; /* bordered_chain.py */
enum { LONGEST = 1 << 24 };              /* no product of sizes overflows */

/* ------------------------------------------------------------------------------------- the door */

typedef struct {
    double *diagonal, *above, *shared;
    const i64 *poses, *landmarks;
    double *seen, *first, *corner, *gradient, *border_gradient;
    long S, M, n, b, d, c, k;
} Equations;

static int read_equations(Door *door, PyObject *tuple, Equations *eq) {
    static const char *const specs[] = {"DSdd", "DAdd", "DSdc", "xM",  "xM", "DMdk",
                                        "Ddb",  "Dbb",  "DSd",  "Db", NULL};
    if (!read_fields(door, tuple, specs, eq, "Equations"))
        return 0;
    const Py_ssize_t *sizes = door->sizes;
    eq->S = (long)sizes['S'], eq->M = (long)sizes['M'], eq->b = (long)sizes['b'];
    eq->d = (long)sizes['d'], eq->c = (long)sizes['c'], eq->k = (long)sizes['k'];
    for (const char *letter = "SMbdck"; *letter; letter++)
        if (sizes[(int)*letter] > LONGEST)
            return refuse("Equations");
    if (eq->S < 1 || sizes['A'] != eq->S - 1 || eq->d < 1 || eq->k < 1 || eq->b < eq->c
        || (eq->b - eq->c) % eq->k)
        return refuse("Equations");
    eq->n = (eq->b - eq->c) / eq->k;
    for (long m = 0; m < eq->M; m++) /* in order */
        if (eq->poses[m] < (m ? eq->poses[m - 1] : 0) || eq->poses[m] >= eq->S)
            return refuse("Equations");
    return are_within(eq->landmarks, eq->M, 0, eq->n - 1) || refuse("Equations");
}

typedef struct {
    const double *pose, *calibration, *points, *information;
    i64 is_relative;
    long m, N;
} Prior;

typedef struct {
    const double *motions, *sensitivities, *information, *calibrations;
} Links;

static const char *const LINKS[] = {"dA44", "dAdc", "dAdd", "dAc", NULL};

/* Points where they were seen; or, of calibrated sensors, which these are, what they showed, and
 * of each its values (psi, d, s, b) and where in the calibration these are; -1 for none. */
enum { VALUES = 8 };  /* of a sensor */
#define LEAST_M 0.05 /* sensor_mounting.py */

typedef struct {
    const double *points, *information, *shares;
    const i64 *sensors;
    const double *origins, *arms, *values;
    const i64 *columns;
    long first, c_s; /* the entries of the calibration that are those of sensors: its last ones */
} Seen;

typedef struct {
    const double *poses, *calibration, *points;
} Solution;

static const char *const SOLUTION[] = {"dS44", "dc", "dn3", NULL};

typedef struct {
    double gate, huber; /* standard deviations; 0 for none */
    i64 is_planar;
} Weighing;

static const char *const WEIGHING[] = {"f", "f", "b", NULL};

static int read_prior(Door *door, PyObject *tuple, const Equations *eq, Prior *prior) {
    static const char *const specs[] = {"d44", "dc", "dm3", "dNN", "b", NULL};
    if (!read_fields(door, tuple, specs, prior, "Prior"))
        return 0;
    prior->m = (long)door->sizes['m'], prior->N = (long)door->sizes['N'];
    return (prior->m <= eq->n && prior->N == eq->d + eq->c + eq->k * prior->m) || refuse("Prior");
}

static int read_seen(Door *door, PyObject *tuple, const Equations *eq, Seen *seen) {
    static const char *const specs[] = {"dM3", "dMkk", "dM",  "~xM",
                                        "~dM3", "~dM3", "dv8", "xv8", NULL};
    if (!read_fields(door, tuple, specs, seen, "Seen"))
        return 0;
    Py_ssize_t count = door->sizes['v'];
    seen->first = eq->c;
    for (Py_ssize_t j = 0; j < VALUES * count; j++) {
        if (seen->columns[j] < -1 || seen->columns[j] >= eq->c)
            return refuse("Seen");
        if (seen->columns[j] >= 0 && seen->columns[j] < seen->first)
            seen->first = (long)seen->columns[j];
    }
    seen->c_s = eq->c - seen->first;
    return seen->sensors == NULL
           || (seen->origins != NULL && seen->arms != NULL
               && are_within(seen->sensors, eq->M, 0, count - 1))
           || refuse("Seen");
}

/* The R poses that are left to the chain, and the rows that link them to the border, last their
 * gradient; J stretches between the first of them are eliminated before. */
typedef struct {
    double *T, *links, *rows;
    long R, J, width;
} Chain;

static int read_chain(Door *door, PyObject *tuple, const Equations *eq, Chain *chain) {
    static const char *const specs[] = {"DRdd", "DQdd", "DRdw", NULL};
    if (!read_fields(door, tuple, specs, chain, "Chain"))
        return 0;
    chain->R = (long)door->sizes['R'], chain->width = (long)door->sizes['w'];
    chain->J = (eq->S - chain->R) / INNER;
    return (chain->R >= 1 && chain->J >= 0 && chain->R + INNER * chain->J == eq->S
            && STRIDE * chain->J < eq->S && door->sizes['Q'] == chain->R - 1
            && chain->width == eq->b + 1)
           || refuse("Chain");
}

/* ------------------------------------------------------------------- matrices of rows, by blocks */

/* C = A B of rows x inner and inner x columns */
static void product(const double *A, const double *B, double *C, long rows, long inner,
                    long columns) {
    memset(C, 0, (size_t)(rows * columns) * sizeof(double));
    for (long i = 0; i < rows; i++)
        for (long l = 0; l < inner; l++)
            for (long j = 0; j < columns; j++)
                C[i * columns + j] += A[i * inner + l] * B[l * columns + j];
}

/* The d rows and columns of M (6 x 6) on the axes that are estimated, with a sign. */
static void estimated(const double M[36], long d, double sign, double *out) {
    long pose = d == 3 ? 2 : 0;
    for (long i = 0; i < d; i++)
        for (long j = 0; j < d; j++)
            out[i * d + j] = sign * M[6 * (pose + i) + pose + j];
}

/* A += s B, of rows that are so far apart */
static void add_block(double *A, long A_stride, const double *B, long B_stride, long rows,
                      long columns) {
    for (long i = 0; i < rows; i++)
        for (long j = 0; j < columns; j++)
            A[i * A_stride + j] += B[i * B_stride + j];
}

/* H (q x q) = J' W J and g (q) = J' W e for J (k x q); ``work``: k q. */
static void normal(const double *J, const double *W, const double *e, long k, long q, double *work,
                   double *H, double *g) {
    product(W, J, work, k, k, q);
    memset(g, 0, (size_t)q * sizeof(double));
    memset(H, 0, (size_t)(q * q) * sizeof(double));
    for (long t = 0; t < k; t++)
        for (long i = 0; i < q; i++) {
            double share = J[t * q + i];
            g[i] += work[t * q + i] * e[t];
            for (long j = 0; j < q && share != 0.0; j++)
                H[i * q + j] += share * work[t * q + j];
        }
}

/* --------------------------------------------------------- linearise: the prior (prior.py), … */

/* Rows b -> J' b, J = [[J_eta, 0, 0], [0, I, 0], [-C, 0, R' of each point]]; ``top``: d width.
 * R is NULL where the prior knows points in the world: there C is zero and R is I. */
static void pull_back(const Equations *eq, const Prior *prior, const double *J_eta,
                      const double *C, const double *R, double *rows, long width, double *top) {
    long d = eq->d, k = eq->k;
    memset(top, 0, (size_t)(d * width) * sizeof(double));
    for (long i = 0; i < d; i++)
        for (long l = 0; l < d; l++)
            for (long j = 0; j < width; j++)
                top[i * width + j] += J_eta[l * d + i] * rows[l * width + j];
    for (long m = 0; m < prior->m && R != NULL; m++) {
        double *block = rows + (d + eq->c + k * m) * width, turned[3];
        for (long t = 0; t < k; t++)
            for (long i = 0; i < d; i++) {
                double share = C[(k * m + t) * d + i];
                for (long j = 0; j < width && share != 0.0; j++)
                    top[i * width + j] -= share * block[t * width + j];
            }
        for (long j = 0; j < width; j++) {
            for (long i = 0; i < k; i++) {
                turned[i] = 0.0;
                for (long t = 0; t < k; t++)
                    turned[i] += R[3 * i + t] * block[t * width + j];
            }
            for (long i = 0; i < k; i++)
                block[i * width + j] = turned[i];
        }
    }
    memcpy(rows, top, (size_t)(d * width) * sizeof(double));
}

static void transposed(const double *M, long d, double *out) {
    for (long i = 0; i < d; i++)
        for (long j = 0; j < d; j++)
            out[i * d + j] = M[j * d + i];
}

/* e of the pose, the calibration and the points; J_eta, and C of each point. */
static void prior_error(const Equations *eq, const Prior *prior, const Solution *at, double *e,
                        double *J_eta, double *C) {
    Pose before = pose_of(prior->pose), now = pose_of(at->poses), off = from_to(&before, &now);
    double eta[6], J[36];
    long d = eq->d, pose = d == 3 ? 2 : 0;
    logarithm(&off, eta);
    right_jacobian_inverse(eta, J);
    estimated(J, d, 1.0, J_eta);
    memcpy(e, eta + pose, (size_t)d * sizeof(double));
    for (long j = 0; j < eq->c; j++)
        e[d + j] = at->calibration[j] - prior->calibration[j];
    for (long m = 0; m < prior->m; m++) {
        double then[3], y[3];
        memcpy(then, prior->points + 3 * m, sizeof then);
        memcpy(y, at->points + 3 * m, sizeof y);
        if (prior->is_relative) {
            seen_from(&before, prior->points + 3 * m, then);
            seen_from(&now, at->points + 3 * m, y);
            output_matrix(y, d, C + eq->k * d * m, d);
        }
        for (long t = 0; t < eq->k; t++)
            e[d + eq->c + eq->k * m + t] = y[t] - then[t];
    }
}

/* ``work``: N (2 N + d + 2) + k m d + d d. */
static void add_prior(const Equations *eq, const Prior *prior, const Solution *at, double *work) {
    long N = prior->N, d = eq->d, known = N - d;
    double *JW = work, *H = JW + N * N, *g = H + N * N, *e = g + N, *top = e + N;
    double *J_eta = top + d * N, *C = J_eta + d * d;
    Pose now = pose_of(at->poses);
    const double *R = prior->is_relative ? now.R : NULL;
    prior_error(eq, prior, at, e, J_eta, C);
    memcpy(JW, prior->information, (size_t)(N * N) * sizeof(double));
    product(JW, e, g, N, N, 1);
    pull_back(eq, prior, J_eta, C, R, g, 1, top);
    pull_back(eq, prior, J_eta, C, R, JW, N, top);
    transposed(JW, N, H);
    pull_back(eq, prior, J_eta, C, R, H, N, top);
    add_block(eq->diagonal, d, H, N, d, d);
    add_block(eq->first, eq->b, H + d, N, d, known);
    add_block(eq->corner, eq->b, H + d * N + d, N, known, known);
    add_block(eq->gradient, d, g, d, 1, d);
    add_block(eq->border_gradient, known, g + d, known, 1, known);
}

/* ------------------------------------------------------------------------------- … motions, … */

/* e = log((M exp(F (c - c_s)))^-1 A_s^-1 A_s+1), and J (d x q) by both poses and the calibration;
 * ``work``: d (2 d + c). */
static void motion_error(const Equations *eq, const Links *links, const Solution *at, long s,
                         double *e, double *J, double *work) {
    long d = eq->d, c = eq->c, q = 2 * d + c, pose = d == 3 ? 2 : 0;
    const double *F = links->sensitivities + s * d * c;
    double eta[6] = {0.0}, error[6], Ad[36], Jr[36], of_off[36];
    for (long i = 0; i < d; i++)
        for (long j = 0; j < c; j++)
            eta[pose + i] += F[i * c + j] * (at->calibration[j] - links->calibrations[s * c + j]);
    /* The motion, had it been computed with this calibration, and its error. */
    Pose before = pose_of(at->poses + 16 * s), after = pose_of(at->poses + 16 * (s + 1));
    Pose stated = pose_of(links->motions + 16 * s), by_off = exponential(eta);
    Pose motion = composed(&stated, &by_off), back = from_to(&after, &before);
    Pose there_and_back = composed(&back, &motion), off = inverse_of(&there_and_back);
    logarithm(&off, error);
    memcpy(e, error + pose, (size_t)d * sizeof(double));
    /* Derivatives by the pose after the motion, by that before, and by the calibration. */
    double J_to[36], by_before[36], J_from[36];
    right_jacobian_inverse(error, Jr);
    estimated(Jr, d, 1.0, J_to);
    adjoint(&back, Ad);
    estimated(Ad, d, -1.0, by_before);
    product(J_to, by_before, J_from, d, d, d);
    memset(J, 0, (size_t)(d * q) * sizeof(double));
    add_block(J, q, J_from, d, d, d);
    add_block(J + d, q, J_to, d, d, d);
    if (!c)
        return;
    adjoint(&there_and_back, Ad);
    right_jacobian(eta, Jr);
    product(Ad, Jr, of_off, 6, 6, 6);
    estimated(of_off, d, -1.0, by_before);
    product(J_to, by_before, J_from, d, d, d);
    product(J_from, F, work, d, d, c);
    add_block(J + 2 * d, q, work, c, d, c);
}

/* ``work``: q (q + 2 d + 1), q = 2 d + c. */
static void add_motion(const Equations *eq, const Links *links, const Solution *at, long s,
                       double *work) {
    long d = eq->d, c = eq->c, q = 2 * d + c;
    double *J = work, *half = J + d * q, *H = half + d * q, *g = H + q * q, e[6];
    double *before = eq->diagonal + s * d * d;
    motion_error(eq, links, at, s, e, J, half);
    normal(J, links->information + s * d * d, e, d, q, half, H, g);
    add_block(before, d, H, q, d, d);
    add_block(before + d * d, d, H + d * q + d, q, d, d);
    add_block(eq->above + s * d * d, d, H + d, q, d, d);
    add_block(eq->shared + s * d * c, c, H + 2 * d, q, d, c);
    add_block(eq->shared + (s + 1) * d * c, c, H + d * q + 2 * d, q, d, c);
    add_block(eq->corner, eq->b, H + 2 * d * q + 2 * d, q, c, c);
    add_block(eq->gradient + s * d, 2 * d, g, q, 1, 2 * d);
    add_block(eq->border_gradient, c, g + 2 * d, c, 1, c);
}

/* ------------------------------------------------- … and observed points (observations.py) */

/* Huber's weight, which falls off faster where a filter would reject. */
static double weight_of(const double *e, const double *information, long k,
                        const Weighing *weighing) {
    double squared = 0.0, gate = weighing->gate, huber = weighing->huber, weight = 1.0;
    for (long i = 0; i < k; i++)
        for (long j = 0; j < k; j++)
            squared += e[i] * information[i * k + j] * e[j];
    if (gate > 0.0)
        weight = smaller(1.0, gate * gate / larger(squared, gate * gate));
    return huber > 0.0 ? weight * huber / sqrt(larger(squared, huber * huber)) : weight;
}

/* What a calibrated sensor shows, y = o + d + e^s (1 - b/|p|) exp(psi) p, and how that changes with
 * its values at l from it, D = [-hat(l) J(psi), I, l, -e^s l/|l|] (sensor_mounting.py). */
static void sense(const Seen *seen, long m, const double predicted[3], double y[3],
                  double D[3 * VALUES]) {
    const double *values = seen->values + VALUES * seen->sensors[m];
    const double *origin = seen->origins + 3 * m, *arm = seen->arms + 3 * m;
    double R[9], J[9], turned[3], l[3];
    exp_and_jacobian(values, R, J);
    turn(R, arm, turned);
    double scale = exp(values[6]) * (1.0 - values[7] / larger(sqrt(dot3(arm, arm)), LEAST_M));
    for (int t = 0; t < 3; t++) {
        y[t] = origin[t] + values[3 + t] + scale * turned[t];
        l[t] = predicted[t] - origin[t] - values[3 + t];
    }
    sensor_matrix(J, l, VALUES, D);
    for (int t = 0; t < 3; t++)
        D[VALUES * t + 7] = -exp(values[6]) / larger(sqrt(dot3(l, l)), LEAST_M) * l[t];
}

/* e = R' (p - x) - y, J (k x q) = [-C, R', -D] by pose, landmark and sensors */
static void point_error(const Equations *eq, const Seen *seen, const Solution *at, long m,
                        double e[3], double *J) {
    long d = eq->d, k = eq->k, q = d + k + seen->c_s;
    double predicted[3], y[3], C[18], D[3 * VALUES];
    Pose pose = pose_of(at->poses + 16 * eq->poses[m]);
    seen_from(&pose, at->points + 3 * eq->landmarks[m], predicted);
    output_matrix(predicted, d, C, d);
    memcpy(y, seen->points + 3 * m, sizeof y);
    memset(J, 0, (size_t)(k * q) * sizeof(double));
    if (seen->sensors != NULL)
        sense(seen, m, predicted, y, D);
    for (long t = 0; t < k; t++) {
        e[t] = predicted[t] - y[t];
        for (long j = 0; j < d; j++)
            J[t * q + j] = -C[t * d + j];
        for (long j = 0; j < k; j++)
            J[t * q + d + j] = pose.R[3 * j + t];
        for (long j = 0; j < VALUES && seen->sensors != NULL; j++) {
            long column = (long)seen->columns[VALUES * seen->sensors[m] + j];
            if (column >= 0)
                J[t * q + d + k + column - seen->first] = -D[VALUES * t + j];
        }
    }
}

/* ``work``: as of motions. */
static void add_point(const Equations *eq, const Seen *seen, const Solution *at,
                      const Weighing *weighing, long m, double *work) {
    long d = eq->d, c = eq->c, k = eq->k, b = eq->b, c_s = seen->c_s, q = d + k + c_s;
    long s = (long)eq->poses[m], column = c + k * (long)eq->landmarks[m], sensors = seen->first;
    double *J = work, *half = J + k * q, *H = half + k * q, *g = H + q * q, e[3], W[9];
    const double *information = seen->information + m * k * k;
    point_error(eq, seen, at, m, e, J);
    double counted = seen->shares[m] * weight_of(e, information, k, weighing);
    for (long j = 0; j < k * k; j++)
        W[j] = counted * information[j];
    normal(J, W, e, k, q, half, H, g);
    add_block(eq->diagonal + s * d * d, d, H, q, d, d);
    add_block(eq->seen + m * d * k, k, H + d, q, d, k);
    add_block(eq->corner + column * b + column, b, H + d * q + d, q, k, k);
    add_block(eq->gradient + s * d, d, g, d, 1, d);
    add_block(eq->border_gradient + column, k, g + d, k, 1, k);
    const double *of_sensors = H + d + k;
    add_block(eq->shared + s * d * c + sensors, c, of_sensors, q, d, c_s);
    add_block(eq->corner + column * b + sensors, b, of_sensors + d * q, q, k, c_s);
    add_block(eq->corner + sensors * b + column, b, H + (d + k) * q + d, q, c_s, k);
    add_block(eq->corner + sensors * b + sensors, b, of_sensors + (d + k) * q, q, c_s, c_s);
    add_block(eq->border_gradient + sensors, c_s, g + d + k, c_s, 1, c_s);
}

static double *work_for(const Equations *eq, const Prior *prior) {
    long N = prior->N, d = eq->d, q = 2 * d + eq->c;
    long size = N * (2 * N + d + 2) + eq->k * prior->m * d + d * d, other = q * (q + 2 * d + 1);
    return PyMem_Malloc((size_t)(size > other ? size : other) * sizeof(double));
}

/* ------------------------------------------------------ eliminate, fill_in: bordered_chain.py */

/* Factors of a chain of poses in place, T = L L' of blocks L on the diagonal and ``links`` below,
 * and L^-1 rows; 0 where T is not positive definite. */
static int forward(double *T, double *links, double *rows, long count, long d, long width) {
    for (long s = 0; s < count; s++, T += d * d, rows += d * width) {
        for (long i = 0; i < d && s; i++)
            for (long l = 0; l < d; l++) {
                const double *link = links + (s - 1) * d * d, *before = rows - (d - l) * width;
                for (long j = 0; j < d; j++)
                    T[i * d + j] -= link[i * d + l] * link[j * d + l];
                for (long j = 0; j < width; j++)
                    rows[i * width + j] -= link[i * d + l] * before[j];
            }
        if (!factor(T, d))
            return 0;
        solve_lower_rows(T, d, rows, width, width);
        for (long i = 0; i < d && s + 1 < count; i++)
            solve_lower(T, d, links + (s * d + i) * d);
    }
    return 1;
}

/* The changes x (count x d) of the poses, from those of what the rows link them to. */
static void backward(const double *L, const double *links, const double *rows, const double *ends,
                     long count, long d, long width, double *x) {
    for (long s = count - 1; s >= 0; s--) {
        for (long i = 0; i < d; i++) {
            const double *row = rows + (s * d + i) * width;
            double sum = 0.0;
            for (long j = 0; j < width; j++)
                sum += row[j] * ends[j];
            for (long j = 0; j < d && s + 1 < count; j++)
                sum += links[(s * d + j) * d + i] * x[(s + 1) * d + j];
            x[s * d + i] = -sum;
        }
        solve_upper(L + s * d * d, d, x + s * d);
    }
}

static long kept(const Chain *chain, long r) { /* which pose is number r of those kept */
    return r <= chain->J ? STRIDE * r : r + INNER * chain->J;
}

/* The poses between two that are kept. Their rows link them to the start, to the end, and to
 * those columns of the border which they saw; ``columns`` has these, last that of the gradient. */
typedef struct {
    double *T, *links, *rows, *ends, *lost;
    i64 *columns, *slots, *begins;
    long width;
} Stretch;

/* Lay the arrays of a stretch out in one piece of memory, ``T``, all members of which have 8
 * bytes; it is NULL where there is none. A stretch sees no more than all of the border. */
static double *lay_out(const Equations *eq, const Chain *chain, Stretch *stretch) {
    long d = eq->d, size = INNER * d * d, width = 2 * d + (chain->J ? eq->b : eq->c) + 1;
    long count = 2 * size + (INNER * d + 3) * width + d * d + eq->n + eq->S + 1;
    stretch->T = PyMem_Malloc((size_t)count * sizeof(double));
    if (stretch->T == NULL)
        return NULL;
    stretch->links = stretch->T + size, stretch->rows = stretch->links + size;
    stretch->ends = stretch->rows + INNER * d * width, stretch->lost = stretch->ends + width;
    stretch->columns = (i64 *)(stretch->lost + width + d * d);
    stretch->slots = stretch->columns + width, stretch->begins = stretch->slots + eq->n;
    memset(stretch->slots, -1, (size_t)eq->n * sizeof(i64));
    for (long s = 0, m = 0; s <= eq->S; s++) {
        while (m < eq->M && eq->poses[m] < s)
            m++;
        stretch->begins[s] = m;
    }
    return stretch->T;
}

/* Take up stretch j and eliminate its poses; 0 where their T is not positive definite. */
static int eliminate_stretch(const Equations *eq, long j, Stretch *stretch) {
    long d = eq->d, c = eq->c, k = eq->k, first = STRIDE * j + 1, width = 2 * d;
    const double *above = eq->above + (first - 1) * d * d;
    for (long i = 0; i < c; i++)
        stretch->columns[width++] = i;
    for (long m = stretch->begins[first]; m < stretch->begins[first + INNER]; m++) {
        long landmark = (long)eq->landmarks[m];
        if (stretch->slots[landmark] >= 0)
            continue;
        stretch->slots[landmark] = width;
        for (long t = 0; t < k; t++)
            stretch->columns[width++] = c + k * landmark + t;
    }
    stretch->columns[width++] = eq->b;
    stretch->width = width;
    memcpy(stretch->T, eq->diagonal + first * d * d, (size_t)(INNER * d * d) * sizeof(double));
    memset(stretch->rows, 0, (size_t)(INNER * d * width) * sizeof(double));
    for (long i = 0; i < INNER; i++) {
        double *rows = stretch->rows + i * d * width;
        if (i + 1 < INNER)
            transposed(above + (i + 1) * d * d, d, stretch->links + i * d * d);
        add_block(rows + 2 * d, width, eq->shared + (first + i) * d * c, c, d, c);
        add_block(rows + width - 1, width, eq->gradient + (first + i) * d, 1, d, 1);
        for (long m = stretch->begins[first + i]; m < stretch->begins[first + i + 1]; m++)
            add_block(rows + stretch->slots[eq->landmarks[m]], width, eq->seen + m * d * k, k, d,
                      k);
    }
    transposed(above, d, stretch->lost); /* to the start, in what is not used yet */
    add_block(stretch->rows, width, stretch->lost, d, d, d);
    add_block(stretch->rows + (INNER - 1) * d * width + d, width, above + INNER * d * d, d, d, d);
    for (long m = stretch->begins[first]; m < stretch->begins[first + INNER]; m++)
        stretch->slots[eq->landmarks[m]] = -1;
    return forward(stretch->T, stretch->links, stretch->rows, INNER, d, width);
}

/* Take from the chain and from the border, as the equations have it, what stretch j has of it. */
static void subtract_stretch(const Equations *eq, const Chain *chain, long j, Stretch *stretch) {
    long d = eq->d, b = eq->b, width = stretch->width, gradient = width - 1;
    const i64 *columns = stretch->columns;
    double *lost = stretch->lost;
    for (long l = 0; l < gradient; l++) {
        memset(lost, 0, (size_t)width * sizeof(double));
        for (long e = 0; e < INNER * d; e++) {
            const double *row = stretch->rows + e * width;
            double share = row[l];
            for (long i = 0; i < width && share != 0.0; i++)
                lost[i] -= share * row[i];
        }
        double *to_border = NULL;
        if (l < d) { /* of the start */
            add_block(chain->T + (j * d + l) * d, d, lost, d, 1, d);
            to_border = chain->rows + (j * d + l) * chain->width;
        } else if (l < 2 * d) { /* of the end */
            add_block(chain->links + (j * d + l - d) * d, d, lost, d, 1, d);
            add_block(chain->T + (j * d + l) * d, d, lost + d, d, 1, d);
            to_border = chain->rows + (j * d + l) * chain->width;
        } else {
            double *row = eq->corner + columns[l] * b;
            for (long i = 2 * d; i < gradient; i++)
                row[columns[i]] += lost[i];
            eq->border_gradient[columns[l]] += lost[gradient];
        }
        for (long i = 2 * d; i < width && to_border != NULL; i++)
            to_border[columns[i]] += lost[i];
    }
}

/* The poses that are kept, as the equations have them. */
static void take_chain(const Equations *eq, const Chain *chain, const i64 *begins) {
    long d = eq->d, b = eq->b, width = chain->width, size = d * d;
    memset(chain->rows, 0, (size_t)(chain->R * d * width) * sizeof(double));
    memset(chain->links, 0, (size_t)((chain->R - 1) * size) * sizeof(double));
    add_block(chain->rows, width, eq->first, b, d, b);
    for (long r = 0; r < chain->R; r++) {
        long s = kept(chain, r);
        double *rows = chain->rows + r * d * width;
        memcpy(chain->T + r * size, eq->diagonal + s * size, (size_t)size * sizeof(double));
        if (r >= chain->J && r + 1 < chain->R)
            transposed(eq->above + s * size, d, chain->links + r * size);
        add_block(rows, width, eq->shared + s * d * eq->c, eq->c, d, eq->c);
        add_block(rows + b, width, eq->gradient + s * d, 1, d, 1);
        for (long m = begins[s]; m < begins[s + 1]; m++)
            add_block(rows + eq->c + eq->k * eq->landmarks[m], width, eq->seen + m * d * eq->k,
                      eq->k, d, eq->k);
    }
}

static int eliminate(const Equations *eq, const Chain *chain, Stretch *stretch) {
    take_chain(eq, chain, stretch->begins);
    for (long j = 0; j < chain->J; j++) {
        if (!eliminate_stretch(eq, j, stretch))
            return 0;
        subtract_stretch(eq, chain, j, stretch);
    }
    return forward(chain->T, chain->links, chain->rows, chain->R, eq->d, chain->width);
}

/* The changes (S, d) of all poses from those of the border, of which one more entry is 1. */
static int fill_in(const Equations *eq, const Chain *chain, const double *border, double *changes,
                   Stretch *stretch) {
    long d = eq->d;
    size_t size = (size_t)d * sizeof(double);
    backward(chain->T, chain->links, chain->rows, border, chain->R, d, chain->width, changes);
    for (long r = chain->R - 1; r > 0; r--) /* to their places, the last first */
        memmove(changes + kept(chain, r) * d, changes + r * d, size);
    for (long j = 0; j < chain->J; j++) {
        double *start = changes + STRIDE * j * d;
        if (!eliminate_stretch(eq, j, stretch))
            return 0;
        memcpy(stretch->ends, start, size);
        memcpy(stretch->ends + d, start + STRIDE * d, size);
        for (long i = 2 * d; i < stretch->width; i++)
            stretch->ends[i] = border[stretch->columns[i]];
        backward(stretch->T, stretch->links, stretch->rows, stretch->ends, INNER, d,
                 stretch->width, start + d);
    }
    return 1;
}

/* ---------------------------------------------------------------------------------- the module */

static PyObject *py_linearise(PyObject *Py_UNUSED(self), PyObject *const *args, Py_ssize_t count) {
    Door door;
    Equations eq;
    Prior prior;
    Links links;
    Seen seen;
    Solution at;
    Weighing weighing;
    open_door(&door);
    if (count != 6)
        refuse("linearise");
    else if (read_equations(&door, args[0], &eq) && read_prior(&door, args[1], &eq, &prior)
             && read_fields(&door, args[2], LINKS, &links, "Links")
             && read_seen(&door, args[3], &eq, &seen)
             && (door.sizes['n'] = eq.n, read_fields(&door, args[4], SOLUTION, &at, "Solution"))
             && read_fields(&door, args[5], WEIGHING, &weighing, "Weighing")
             && ((eq.d == (weighing.is_planar ? 3 : 6) && eq.k == (weighing.is_planar ? 2 : 3))
                 || refuse("Weighing"))) {
        double *work = work_for(&eq, &prior);
        if (work == NULL)
            PyErr_NoMemory();
        else {
            Py_BEGIN_ALLOW_THREADS
            add_prior(&eq, &prior, &at, work);
            for (long s = 0; s + 1 < eq.S; s++)
                add_motion(&eq, &links, &at, s, work);
            for (long m = 0; m < eq.M; m++)
                add_point(&eq, &seen, &at, &weighing, m, work);
            Py_END_ALLOW_THREADS
        }
        PyMem_Free(work);
    }
    close_door(&door);
    if (PyErr_Occurred())
        return NULL;
    Py_RETURN_NONE;
}

/* Both take equations and a chain; fill_in() the border's changes, and those of all poses, too. */
static PyObject *py_solve(PyObject *Py_UNUSED(self), PyObject *const *args, Py_ssize_t count) {
    Door door;
    Equations eq;
    Chain chain;
    Stretch stretch;
    double *border = NULL, *changes = NULL;
    int is_regular = 0, fills_in = count > 2;
    open_door(&door);
    if (count != (fills_in ? 4 : 2))
        refuse("eliminate or fill_in");
    else if (read_equations(&door, args[0], &eq) && read_chain(&door, args[1], &eq, &chain)
             && (!fills_in || ((border = read_array(&door, args[2], "dw", "border")) != NULL
                               && (changes = read_array(&door, args[3], "DSd", "changes"))))) {
        double *memory = lay_out(&eq, &chain, &stretch);
        if (memory == NULL)
            PyErr_NoMemory();
        else {
            Py_BEGIN_ALLOW_THREADS
            is_regular = fills_in ? fill_in(&eq, &chain, border, changes, &stretch)
                                  : eliminate(&eq, &chain, &stretch);
            Py_END_ALLOW_THREADS
        }
        PyMem_Free(memory);
    }
    close_door(&door);
    return PyErr_Occurred() ? NULL : PyBool_FromLong(is_regular);
}

static PyMethodDef methods[] = {
    METHOD("linearise", py_linearise, "Fill in equations."),
    METHOD("eliminate", py_solve, "Leave the border."),
    METHOD("fill_in", py_solve, "Find all changes."),
    {NULL, NULL, 0, NULL},
};

MODULE(_gauss_newton, "Gauss-Newton in C.")
