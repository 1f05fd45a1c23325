/* The step in C: the functions of step.py once more, in that order and by the same names.
 *
 * advance() moves a state along velocities (27), observe() by the innovation (28)-(31), both on
 * the arrays of flat_arrays.py. UNUSUAL comes back before anything is changed, for a gap in the
 * velocities, landmarks that move, and where rounding has left no digits: Python goes on over the
 * same arrays. step.py says what the equations mean, and the units; a change is made in both, and
 * test/filter/test_core.py holds each step of either to the other. Arrays are checked as they come
 * in, by the functions named read_..., and nothing is after them or kept from call to call. */
#include "_door.h" /* first, as it includes Python.h */
#include "_se3.h"

enum { UNUSUAL = -1, AT_REST = 0, DONE = 1, REJECTS = 2 };

static const double TINY = 2.2250738585072014e-308;
static const double LEAD_S = 0.5;            /* held_velocities.py */
static const double MEMORY = 300.0, MAX_STEP = 0.5, RARE = 2.33; /* motion_noise.py */
static const double LEAST_LOGARITHM = -4.605170185988091, LARGEST_LOGARITHM = 6.907755278982137;
static const double MAX_SPEED_ERRORS[2] = {50.0, 1000.0};
static const double RESOLUTION_M = 1e-4, RELATIVE_RESOLUTION = 1e-6; /* observation_noise.py */
static const double MAX_ERROR_M = 1e3, MIN_INTERVAL_S = 1e-3;
static const double MIN_SHARE = 1e-6, MOST_SHARE_M2 = 1e-6;
static const double LOST = 1e-7;             /* matrices.py */
static const double LOG_ROOT_2_PI = 0.9189385332046728;
static const int REWEIGHTINGS = 2;
static const i64 LATEST_NS = (i64)1 << 61;   /* stamps beyond it are unusual: no sum overflows */
static const i64 DELAY = 42; /* which entry of a calibration it is, behind those of [M b] */
static const long MAX_ROOM = 1 << 15;        /* rows of P: no product of sizes overflows */

static double seconds(i64 later_ns, i64 since_ns) { return (double)(later_ns - since_ns) / 1e9; }

/* -------------------------------------------- P, of which both triangles are kept: P += s U' V */

enum { TALL = 4, WIDE = 64, MIRRORED = 32 };

#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__) \
    && !defined(__SANITIZE_ADDRESS__)
#define FOR_EACH_PROCESSOR __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define FOR_EACH_PROCESSOR
#endif

/* A block of TALL x WIDE entries at (i, j), which stays in registers for all rows of U and V. */
FOR_EACH_PROCESSOR
static void add_to_block(double *P, long room, const double *U, const double *V, long stride,
                         long rank, double sign, long i, long j) {
    double sums[TALL][WIDE];
    for (int t = 0; t < TALL; t++)
        memcpy(sums[t], P + (i + t) * room + j, sizeof sums[t]);
    for (long q = 0; q < rank; q++) {
        const double *u = U + q * stride + i, *v = V + q * stride + j;
        double u0 = sign * u[0], u1 = sign * u[1], u2 = sign * u[2], u3 = sign * u[3];
        for (int s = 0; s < WIDE; s++) {
            sums[0][s] += u0 * v[s];
            sums[1][s] += u1 * v[s];
            sums[2][s] += u2 * v[s];
            sums[3][s] += u3 * v[s];
        }
    }
    for (int t = 0; t < TALL; t++)
        memcpy(P + (i + t) * room + j, sums[t], sizeof sums[t]);
}

FOR_EACH_PROCESSOR
static void add_to_row(double *row, const double *V, long stride, const double *u, long rank,
                       double sign, long first, long last) {
    for (long q = 0; q < rank; q++) {
        const double *v = V + q * stride, factor = sign * u[q * stride];
        for (long j = first; j < last; j++)
            row[j] += factor * v[j];
    }
}

/* Add s U' V, of rows (rank, stride), to the upper triangle of the first N rows and columns.
 * What that does to some of the lower one is undone by mirror(). */
static void add_product(double *P, long room, long N, const double *U, const double *V,
                        long stride, long rank, double sign) {
    for (long j = 0; j < N; j += WIDE) {
        long end_j = j + WIDE < N ? j + WIDE : N;
        for (long i = 0; i < end_j; i += TALL) {
            long end_i = i + TALL < end_j ? i + TALL : end_j;
            if (end_i - i == TALL && end_j - j == WIDE) {
                add_to_block(P, room, U, V, stride, rank, sign, i, j);
                continue;
            }
            for (long row = i; row < end_i; row++)
                add_to_row(P + row * room, V, stride, U + row, rank, sign, row > j ? row : j,
                           end_j);
        }
    }
}

static void mirror(double *P, long room, long N) { /* the upper triangle to the lower one */
    for (long i = 0; i < N; i += MIRRORED)
        for (long j = i; j < N; j += MIRRORED)
            for (long row = i; row < i + MIRRORED && row < N; row++)
                for (long col = j > row ? j : row + 1; col < j + MIRRORED && col < N; col++)
                    P[col * room + row] = P[row * room + col];
}

/* ------------------------------------- the door: structs of the tuples from flat_arrays.py */

static int is_stamp(i64 stamp_ns) { return -LATEST_NS < stamp_ns && stamp_ns < LATEST_NS; }

/* The structs begin with the fields of the tuples of that name, in their order. */

typedef struct {
    const double *A, *y_ref;
    double *a, *P;
    i64 N, first, stride, is_planar;
    const double *rates;
    const i64 *estimated;
    const double *drift, *u;
    long n, room, c, c_v;
    int p, k, pose, turns; /* pose: which of the six axes of a twist comes first */
} FilterState;

static int read_estimate(Door *door, PyObject *tuple, FilterState *x) {
    static const char *const specs[] = {"d44", "dn3", "Dn3", "DRR", "i", "i", "i", "b", "d67",
                                        "xv", "dcc", "~dn3", NULL};
    if (!read_fields(door, tuple, specs, x, "FilterState"))
        return 0;
    x->p = x->is_planar ? 3 : 6;
    x->k = x->is_planar ? 2 : 3;
    x->pose = x->is_planar ? 2 : 0;
    x->turns = x->is_planar ? 1 : 3;
    x->n = (long)door->sizes['n'], x->room = (long)door->sizes['R'];
    x->c = (long)door->sizes['c'], x->c_v = (long)door->sizes['v'];
    door->sizes['p'] = x->p;
    if (x->room > MAX_ROOM || x->n > MAX_ROOM || x->c > MAX_ROOM || x->c_v > x->c
        || x->first < x->p + x->c || x->first > x->room || (x->stride != 0 && x->stride < x->k)
        || x->stride > MAX_ROOM || x->N != x->first + x->stride * x->n
        || x->N > x->room || !are_within(x->estimated, x->c_v, 0, DELAY))
        return refuse("FilterState");
    door->sizes['N'] = (Py_ssize_t)x->N;
    return 1;
}

typedef struct {
    const i64 *stamps_ns;
    const double *V;
    const i64 *since_ns;
    const char *is_stated;
    const double *covariances;
    double usual_s[2];
    i64 timeout_ns;
    long count;
} Velocities;

static const char *const VELOCITIES[] = {"lr",   "dr6", "lr2", "?r2",
                                          "dr66", "f",   "f",   "i",   NULL};

typedef struct {
    i64 start_ns, end_ns, delay_ns, reach_ns;
    const double *at_start;
} Interval;

static const char *const INTERVAL[] = {"i", "i", "i", "i", "~d6", NULL};

typedef struct {
    const double *densities, *scales, *factors, *unknown;
} MotionFigures;

static const char *const MOTION_FIGURES[] = {"d6", "d6", "d2", "d6", NULL};

typedef struct {
    double *A, *noise, *of_turning, *F, *at_end, *variances;
} Advanced;

static const char *const ADVANCED[] = {"D44", "Dpp", "Dpp", "Dpc", "D6", "D6", NULL};

typedef struct {
    i64 *counts, *rejections, *last_seen_ns, *seen_before_ns;
} Landmarks;

static const char *const LANDMARKS[] = {"Ln", "Ln", "Ln", "Ln", NULL};

typedef struct {
    i64 stamp_ns;
    const i64 *rows;
    const double *arms, *origins, *covariances, *directions, *sensor;
    const i64 *of_sensor;
    i64 column;
    const double *D;
    long m, c_s;
} Seen;

static int read_seen(Door *door, PyObject *tuple, const FilterState *x, Seen *seen) {
    static const char *const specs[] = {"i",   "xm", "dm3", "~dm3",  "~dm33", "~dm33",
                                        "~d7", "xs", "i",   "~dm3c", NULL};
    if (!read_fields(door, tuple, specs, seen, "Seen"))
        return 0;
    seen->m = (long)door->sizes['m'];
    seen->c_s = seen->sensor == NULL ? 0 : (long)door->sizes['s'];
    door->sizes['o'] = seen->covariances == NULL ? 0 : seen->m;
    return (seen->column >= 0 && seen->column <= x->c && seen->c_s <= x->c - seen->column
            && are_within(seen->of_sensor, seen->c_s, 0, 6)
            && are_within(seen->rows, seen->m, -1, x->n - 1))
           || refuse("Seen");
}

typedef struct {
    double along_0, along_2, along_4, across_0, across_2;
} PointFigures;

static const char *const POINT_FIGURES[] = {"f", "f", "f", "f", "f", NULL};

typedef struct {
    double gate, huber, error_time_s;
    i64 confirmations, max_rejections, may_refuse;
} Limits;

static const char *const LIMITS[] = {"f", "f", "f", "i", "i", "i", NULL};

typedef struct {
    const double *shares;
    double *logs, *information, *applied, least;
    int are_there;
} Factors;

static const char *const FACTORS[] = {"d2pp", "D2", "D22", "D2", "f", NULL};

typedef struct {
    double *A, *points, *r, *weights, *origins, *lines_of_sight, *covariances, *repeated, *moved;
    double *judged;
    int judges;
} Observed;

static int read_observed(Door *door, PyObject *tuple, Observed *out) {
    static const char *const specs[] = {"D44", "Dm3", "Dm3", "Dm", "Dm3", "Dm3",
                                        "Do33", "Dm", "DN", "Dj", NULL};
    if (!read_fields(door, tuple, specs, out, "Observed"))
        return 0;
    Py_ssize_t judged = door->sizes['j'];
    out->judges = judged > 0;
    return judged == 0 || judged == 3 * door->sizes['m'] + 1 || refuse("Observed");
}

/* ---------------------------------------------------------------------------- a motion: (27) */

enum { MAX_PIECES = 4096 };

typedef struct {
    double dt_s, before_s[2], V[6], Q[6]; /* Q: variances of what it moves the robot by, … */
    double stated[36];                    /* … and covariances, where they were stated */
    double until_s, moved[6];             /* sums up to its end */
    int is_stated[2], moves;
} Piece;

/* How many entries are before a stamp, or also at it: bisection. */
static long rows_up_to(const i64 *stamps_ns, long count, i64 stamp_ns, int and_at) {
    long low = 0, high = count;
    while (low < high) {
        long middle = low + (high - low) / 2;
        if (and_at ? stamps_ns[middle] <= stamp_ns : stamps_ns[middle] < stamp_ns)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

static int is_zero(const double *v, int n) {
    for (int j = 0; j < n; j++)
        if (v[j] != 0.0)
            return 0;
    return 1;
}

static void calibrated(const FilterState *x, const double V[6], double out[6]) { /* M V + b */
    int is_moving = !is_zero(V, 6);
    for (int i = 0; i < 6; i++) {
        const double *row = x->rates + 7 * i;
        out[i] = 0.0;
        for (int j = 0; j < 6; j++)
            out[i] += row[j] * V[j];
        out[i] += is_moving ? row[6] : 0.0;
    }
}

/* Fill in pieces [first, last); 0 for gaps. */
static int fill_pieces(const Velocities *v, long first, long last, i64 start_ns, i64 end_ns,
                       int is_planar, Piece *pieces) {
    for (long row = first; row < last; row++) {
        Piece *piece = &pieces[row - first];
        const i64 *since_ns = v->since_ns + 2 * row;
        i64 begins_ns = v->stamps_ns[row] > start_ns ? v->stamps_ns[row] : start_ns;
        i64 ends_ns = row + 1 < last ? v->stamps_ns[row + 1] : end_ns;
        if (!is_stamp(begins_ns) || !is_stamp(ends_ns) || !is_stamp(since_ns[0])
            || !is_stamp(since_ns[1]) || since_ns[1] + v->timeout_ns < ends_ns)
            return 0;
        piece->dt_s = seconds(ends_ns, begins_ns);
        piece->before_s[0] = seconds(begins_ns, since_ns[0]);
        piece->before_s[1] = seconds(begins_ns, since_ns[1]);
        piece->is_stated[0] = v->is_stated[2 * row], piece->is_stated[1] = v->is_stated[2 * row + 1];
        if (piece->is_stated[0] || piece->is_stated[1])
            memcpy(piece->stated, v->covariances + 36 * row, sizeof piece->stated);
        memcpy(piece->V, v->V + 6 * row, sizeof piece->V);
        if (is_planar)
            piece->V[0] = piece->V[1] = piece->V[5] = 0.0;
        piece->moves = !is_zero(piece->V, 6);
    }
    return 1;
}

/* Noise in proportion to the mean velocity over a window around the middle of each piece, and to
 * the mean until its end over half of that time at least. */
static void add_scale_noise(Piece *pieces, long k, long lead, const double scales[6]) {
    for (long i = -lead; i < k; i++) { /* sums, of which the first follows one of nothing */
        pieces[i].until_s = pieces[i - 1].until_s + pieces[i].dt_s;
        for (int j = 0; j < 6; j++)
            pieces[i].moved[j] = pieces[i - 1].moved[j] + pieces[i].dt_s * pieces[i].V[j];
    }
    long first = -1, last = -1, since = -lead - 1; /* behind first and since, to the end of last */
    for (long i = 0; i < k; i++) {
        double middle_s = 0.5 * (pieces[i - 1].until_s + pieces[i].until_s);
        while (first < i - 1 && pieces[first].until_s < middle_s - LEAD_S)
            first++;
        while (last < k - 1 && (last < i || pieces[last + 1].until_s <= middle_s + LEAD_S))
            last++;
        while (since < first && pieces[since].until_s < pieces[last].until_s - LEAD_S)
            since++;
        const Piece *end = &pieces[last], *begin = &pieces[first], *before = &pieces[since];
        double here_s = larger(end->until_s - begin->until_s, TINY);
        double late_s = larger(end->until_s - before->until_s, TINY);
        for (int j = 0; j < 6; j++)
            pieces[i].Q[j] += scales[j] * scales[j] * pieces[i].dt_s
                              * fabs((end->moved[j] - begin->moved[j]) / here_s
                                     * ((end->moved[j] - before->moved[j]) / late_s));
    }
}

/* What is stated is of one error for as long as a velocity is held, which moves the robot by so
 * much more; errors beyond the largest that there are say no more than these. */
static void fill_stated(Piece *piece, const double factors[2]) {
    double grown_s[6], *C = piece->stated;
    for (int j = 0; j < 6; j++) {
        double squared = piece->dt_s * (2.0 * piece->before_s[j / 3] + piece->dt_s);
        double deviation = sqrt(larger(C[7 * j], 0.0)), largest = MAX_SPEED_ERRORS[j / 3];
        grown_s[j] = sqrt(squared * factors[j / 3]) * largest / larger(deviation, largest);
        piece->Q[j] *= !piece->is_stated[j / 3];
    }
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++)
            C[6 * i + j] *= grown_s[i] * grown_s[j];
}

/* White noise: held longer than usual, one error has moved the robot by so much more. */
static void fill_variances(Piece *pieces, long k, long lead, const Velocities *v,
                           const Interval *interval, const MotionFigures *figures) {
    double ahead_s = interval->delay_ns < 0 ? (double)-interval->delay_ns / 1e9 : 0.0;
    double usual_s[2] = {v->usual_s[0] + ahead_s, v->usual_s[1] + ahead_s};
    int some_last = 0;
    for (long i = 0; i < k; i++)
        for (int s = 0; s < 2; s++)
            some_last |= pieces[i].before_s[s] + pieces[i].dt_s > usual_s[s];
    for (long i = 0; i < k; i++)
        for (int j = 0; j < 6; j++) {
            double before_s = pieces[i].before_s[j / 3], until_s = before_s + pieces[i].dt_s;
            double white_s = pieces[i].dt_s;
            if (some_last)
                white_s = until_s * larger(until_s / usual_s[j / 3], 1.0)
                          - before_s * larger(before_s / usual_s[j / 3], 1.0);
            pieces[i].Q[j] = figures->densities[j] * white_s;
        }
    if (!is_zero(figures->scales, 6))
        add_scale_noise(pieces, k, lead, figures->scales);
    for (long i = 0; i < k; i++) {
        for (int j = 0; j < 6; j++)
            pieces[i].Q[j] *= figures->factors[j / 3];
        if (pieces[i].is_stated[0] || pieces[i].is_stated[1])
            fill_stated(&pieces[i], figures->factors);
    }
}

static const double *stated_of(const Piece *piece) { /* NULL where nothing is stated */
    return piece && (piece->is_stated[0] || piece->is_stated[1]) ? piece->stated : NULL;
}

/* Add Ad Q Ad' of what is stated: half of the pieces before and after a pose, either of which may
 * be NULL. What turning and driving share is half theirs. */
static void add_stated(int p, const double *Ad, const double *before, const double *after,
                       const Advanced *out) {
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) {
            int e = 6 * i + j;
            double Q = 0.5 * ((before ? before[e] : 0.0) + (after ? after[e] : 0.0));
            double turning = 0.5 * ((i < 3) + (j < 3)) * Q;
            for (int s = 0; s < p; s++)
                for (int t = s; t < p && Q != 0.0; t++) {
                    out->noise[s * p + t] += Ad[6 * s + i] * Q * Ad[6 * t + j];
                    out->of_turning[s * p + t] += Ad[6 * s + i] * turning * Ad[6 * t + j];
                }
        }
}

/* Add Ad Q Ad' and how the calibration turns, of what belongs to one pose by the trapezoidal rule:
 * halves of the pieces before and after it, either of which may be missing. */
static void add_at_pose(const FilterState *x, const double *Ad, const Piece *before,
                        const Piece *after, const Advanced *out) {
    int p = x->p;
    double Q[6] = {0.0};
    for (int j = 0; j < 6; j++)
        Q[j] = 0.5 * ((before ? before->Q[j] : 0.0) + (after ? after->Q[j] : 0.0));
    for (int s = 0; s < p; s++)
        for (int t = s; t < p; t++) {
            double turning = 0.0, driving = 0.0;
            for (int j = 0; j < 3; j++) {
                turning += Ad[6 * s + j] * Q[j] * Ad[6 * t + j];
                driving += Ad[6 * s + 3 + j] * Q[3 + j] * Ad[6 * t + 3 + j];
            }
            out->of_turning[s * p + t] += turning;
            out->noise[s * p + t] += turning + driving;
        }
    if (stated_of(before) || stated_of(after))
        add_stated(p, Ad, stated_of(before), stated_of(after), out);
    for (long j = 0; j < x->c_v; j++) {
        int row = (int)x->estimated[j] / 7, column = (int)x->estimated[j] % 7;
        double share = 0.0;
        if (x->estimated[j] == DELAY)
            continue;
        for (int part = 0; part < 2; part++) {
            const Piece *piece = part ? after : before;
            if (piece)
                share += 0.5 * piece->dt_s * (column == 6 ? piece->moves : piece->V[column]);
        }
        for (int s = 0; s < p; s++)
            out->F[s * x->c + j] += Ad[6 * s + row] * share;
    }
}

/* The mean velocity about a stamp, as far as its delay may reach; 0 where a stamp is unusual. */
static int mean_about(i64 stamp_ns, const Velocities *v, const Interval *interval, int is_planar,
                      double mean[6]) {
    i64 centre_ns = stamp_ns - interval->delay_ns;
    i64 start_ns = centre_ns - interval->reach_ns, end_ns = centre_ns + interval->reach_ns;
    long first = rows_up_to(v->stamps_ns, v->count, start_ns, 1) - 1;
    long last = rows_up_to(v->stamps_ns, v->count, end_ns, 0);
    double known_s = 0.0;
    memset(mean, 0, 6 * sizeof(double));
    if (first < 0)
        return 0;
    for (long row = first; row < last; row++) {
        i64 begins_ns = v->stamps_ns[row], since_ns = v->since_ns[2 * row + 1];
        i64 ends_ns = row + 1 < last ? v->stamps_ns[row + 1] : end_ns;
        if (!is_stamp(begins_ns) || !is_stamp(ends_ns) || !is_stamp(since_ns))
            return 0;
        begins_ns = begins_ns < start_ns ? start_ns : begins_ns;
        i64 stops_ns = since_ns + v->timeout_ns;
        stops_ns = stops_ns > ends_ns ? ends_ns : stops_ns < begins_ns ? begins_ns : stops_ns;
        double held_s = seconds(stops_ns, begins_ns);
        known_s += held_s;
        for (int j = 0; j < 6; j++)
            mean[j] += held_s * v->V[6 * row + j];
    }
    for (int j = 0; j < 6; j++)
        mean[j] = known_s != 0.0 ? mean[j] / known_s : 0.0;
    if (is_planar)
        mean[0] = mean[1] = mean[5] = 0.0;
    return 1;
}

/* (27)  A <- A exp(V dt) along the pieces, with noise, F and Ad at both ends. */
static void follow_path(const FilterState *x, const Piece *pieces, long k, const Advanced *out,
                        double first[36], double last[36]) {
    int p = x->p;
    Pose pose = pose_of(x->A);
    memset(out->noise, 0, (size_t)(p * p) * sizeof(double));
    memset(out->of_turning, 0, (size_t)(p * p) * sizeof(double));
    memset(out->F, 0, (size_t)(p * x->c) * sizeof(double));
    for (long i = 0; i <= k; i++) {
        const Piece *before = i > 0 ? &pieces[i - 1] : NULL, *after = i < k ? &pieces[i] : NULL;
        adjoint(&pose, last);
        if (i == 0)
            memcpy(first, last, 36 * sizeof(double));
        add_at_pose(x, last + 6 * x->pose, before, after, out);
        if (after == NULL)
            break;
        double twist[6];
        calibrated(x, after->V, twist);
        for (int j = 0; j < 6; j++)
            twist[j] *= after->dt_s;
        Pose step = exponential(twist);
        pose = composed(&pose, &step);
    }
    mirror(out->noise, p, p);
    mirror(out->of_turning, p, p);
    normalise(pose.R);
    write_pose(&pose, out->A);
}

/* x <- x + J (F c + w): P + J' B + B' J with B = F P_c + (noise + F P_cc F') J / 2.
 * J, of rows like P's, is I for the pose, and turns every landmark. ``work``: 2 p N. */
static void spread(const FilterState *x, const double *noise, const double *F, double *work) {
    long N = x->N, room = x->room, first = x->first, c = x->c;
    int p = x->p, turns = x->turns;
    double *J = work, *B = work + p * N, *P = x->P;
    memset(J, 0, (size_t)(2 * p * N) * sizeof(double));
    for (int s = 0; s < p; s++)
        J[s * N + s] = 1.0;
    for (long i = 0; i < x->n && x->stride; i++) { /* an exact map has no errors */
        double y[3], K[9];
        for (int b = 0; b < 3; b++)
            y[b] = x->y_ref[3 * i + b] + x->a[3 * i + b];
        hat(y, K);
        for (int s = 0; s < turns; s++)
            for (int b = 0; b < x->k; b++)
                J[s * N + first + x->stride * i + b] = K[3 * b + x->pose + s];
    }
    for (int s = 0; s < p; s++) {
        double *row = B + s * N;
        for (long q = 0; q < c; q++) {
            const double *of_c = P + (p + q) * room;
            double share = F[s * c + q];
            for (long j = 0; j < N && share != 0.0; j++)
                row[j] += share * of_c[j];
        }
        for (int t = 0; t < p; t++) {
            double half = noise[s * p + t];
            for (long q = 0; q < c; q++)
                for (long u = 0; u < c; u++)
                    half += F[s * c + q] * P[(p + q) * room + p + u] * F[t * c + u];
            for (long j = 0; j < N; j++)
                row[j] += 0.5 * half * J[t * N + j];
        }
    }
    /* Only the turns move landmarks: the shifts' rows of J are those of the pose alone. */
    add_product(P, room, N, J, B, N, turns, 1.0);
    add_product(P, room, N, B, J, N, turns, 1.0);
    for (long s = turns; s < p; s++)
        for (long j = 0; j < N; j++)
            P[(j < s ? j : s) * room + (j < s ? s : j)] += B[s * N + j] * (j == s ? 2.0 : 1.0);
    mirror(P, room, N);
}

/* Move X along velocities (27), with what that does to P. */
static int advance(const FilterState *x, const Velocities *v, const Interval *interval,
                   const MotionFigures *figures, const Advanced *out) {
    if (!is_stamp(interval->start_ns) || !is_stamp(interval->end_ns)
        || !is_stamp(interval->delay_ns) || !is_stamp(interval->reach_ns)
        || !is_stamp(v->timeout_ns) || (interval->reach_ns && !x->c_v) || x->u != NULL)
        return UNUSUAL;
    i64 start_ns = interval->start_ns - interval->delay_ns;
    i64 end_ns = interval->end_ns - interval->delay_ns;
    long first = rows_up_to(v->stamps_ns, v->count, start_ns, 1) - 1;
    long last = rows_up_to(v->stamps_ns, v->count, end_ns, 0);
    last = last > first ? last : first + 1; /* between the same stamps: a piece without time */
    long k = last - first, lead = first > 0 && !is_zero(figures->scales, 6);
    i64 lead_ns = start_ns - (i64)(1e9 * LEAD_S);
    while (lead > 0 && lead < first && v->stamps_ns[first + 1 - lead] > lead_ns)
        lead++;
    if (first < 0 || end_ns < start_ns || k + lead > MAX_PIECES)
        return UNUSUAL;
    double at_start[6], at_end[6], ad_first[36], ad_last[36];
    if (interval->reach_ns) {
        if (interval->at_start != NULL)
            memcpy(at_start, interval->at_start, sizeof at_start);
        else if (!mean_about(interval->start_ns, v, interval, x->is_planar, at_start))
            return UNUSUAL;
        if (!mean_about(interval->end_ns, v, interval, x->is_planar, at_end))
            return UNUSUAL;
    }
    size_t pieces_size = (size_t)(lead + 1 + k) * sizeof(Piece);
    char *memory = PyMem_Malloc(pieces_size + (size_t)(2 * x->p * x->N) * sizeof(double));
    if (memory == NULL)
        return UNUSUAL;
    Piece *pieces = (Piece *)memory + 1 + lead; /* behind one of nothing, at which sums begin */
    memset(memory, 0, sizeof(Piece));
    int status = UNUSUAL;
    if (fill_pieces(v, first + 1 - lead, first + 1, lead_ns, start_ns, 0, pieces - lead)
        && fill_pieces(v, first, last, start_ns, end_ns, x->is_planar, pieces)) {
        int some_move = 0, some_are_empty = 0;
        fill_variances(pieces, k, lead, v, interval, figures);
        memset(out->variances, 0, 6 * sizeof(double));
        for (long i = 0; i < k; i++) {
            some_move |= pieces[i].moves, some_are_empty |= pieces[i].dt_s == 0.0;
            const double *stated = stated_of(&pieces[i]);
            for (int j = 0; j < 6; j++)
                out->variances[j] += pieces[i].Q[j] + (stated ? stated[7 * j] : 0.0);
        }
        status = some_move && !some_are_empty ? DONE : AT_REST;
        follow_path(x, pieces, k, out, ad_first, ad_last);
        if (interval->reach_ns) { /* of a delay, F is what the velocity at its ends differs by */
            double before[6], after[6];
            memcpy(out->at_end, at_end, sizeof at_end);
            calibrated(x, at_start, before);
            calibrated(x, at_end, after);
            for (int s = 0, row = 6 * x->pose; s < x->p; s++, row += 6) {
                double sum = 0.0;
                for (int j = 0; j < 6; j++)
                    sum += ad_first[row + j] * before[j] - ad_last[row + j] * after[j];
                out->F[s * x->c + x->c_v - 1] = sum;
            }
        }
        spread(x, out->noise, out->F, (double *)(memory + pieces_size));
        for (long q = 0; q < x->c; q++)
            for (long u = 0; u < x->c; u++)
                x->P[(x->p + q) * x->room + x->p + u] +=
                    x->drift[q * x->c + u] * seconds(interval->end_ns, interval->start_ns);
    }
    PyMem_Free(memory);
    return status;
}

/* --------------------------------------------------------------- an observation: (28) to (31) */

/* What m known landmarks say against the state, reference frame, k axes: M = m k, q = p + c. */
typedef struct {
    long m, M, q;
    int k, has_sensor, has_halves;
    i64 *rows, *at;          /* (m) which landmarks are seen, and by which of the points */
    double *points, *stated; /* (m, 3) estimated; of all points covariances as stated, body frame */
    double *off;             /* (M) r along the estimated axes */
    double *directions;      /* (m, k, k) along which points are measured, as rows, others zero */
    double *r, *R;           /* (M); (m, k, k): along these */
    double *D;               /* (M, c) how r changes with the calibration */
    double *repeated;        /* (m) by how much R grows, as errors last */
    double *predicted, *S, *L, *z, *S_inv_r; /* (M, M) C P C' and with noise, its factor; (M) */
    double *C, *T;           /* (M, q) and P's rows of the landmarks there */
    double *half;            /* (q) */
    double *W, *dx;          /* (M, N); (N) */
    double *weights;
} Residuals;

/* Lay the arrays of residuals out in one piece of memory, or count how many numbers they take. */
static size_t lay_out(Residuals *res, const FilterState *x, long m, long of_all, double *memory) {
    size_t k = (size_t)x->k, n = (size_t)m, M = n * k, c = (size_t)x->c;
    size_t q = (size_t)x->p + c;
    size_t used = 0;
    res->m = m, res->M = (long)M, res->q = (long)q, res->k = x->k;
#define TAKE(field, count) (res->field = memory ? memory + used : NULL, used += (count))
    TAKE(points, 3 * n), TAKE(stated, 9 * (size_t)of_all), TAKE(off, M), TAKE(directions, M * k);
    TAKE(r, M), TAKE(R, M * k), TAKE(D, M * c);
    TAKE(repeated, n), TAKE(predicted, M * M), TAKE(S, M * M), TAKE(L, M * M), TAKE(z, M);
    TAKE(S_inv_r, M), TAKE(C, M * q), TAKE(T, M * q), TAKE(half, q), TAKE(W, M * (size_t)x->N);
    TAKE(dx, (size_t)x->N), TAKE(weights, n);
#undef TAKE
    return used;
}

static void add_to_diagonal(double C[9], double variance) {
    C[0] += variance, C[4] += variance, C[8] += variance;
}

/* The covariance of a point along a line of sight by its figures: along, and across. */
static void point_covariance(const double line[3], const PointFigures *figures, double C[9]) {
    double square = dot3(line, line), most = MAX_ERROR_M * MAX_ERROR_M;
    double along = figures->along_0 + (figures->along_2 + figures->along_4 * square) * square;
    along = along < most ? along : most;
    double across = figures->across_0 + figures->across_2 * square;
    across = square > 0.0 ? (across < most ? across : most) : along;
    double excess = (along - across) / larger(square, TINY);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            C[3 * i + j] = excess * line[i] * line[j];
    double share = fmin(MIN_SHARE * (along + 2.0 * across), MOST_SHARE_M2);
    add_to_diagonal(C, across + RESOLUTION_M * RESOLUTION_M + share);
}

/* That of a point y as stated, such that it can be inverted; by the figures if it is not. */
static void stated_covariance(const double y[3], const double *stated, const double line[3],
                              const PointFigures *figures, double C[9]) {
    if (stated == NULL || is_zero(stated, 9)) {
        point_covariance(line, figures, C);
        return;
    }
    double scales[3];
    for (int i = 0; i < 3; i++)
        scales[i] = MAX_ERROR_M / larger(sqrt(larger(stated[4 * i], 0.0)), MAX_ERROR_M);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            C[3 * i + j] = stated[3 * i + j] * scales[i] * scales[j];
    add_to_diagonal(C, RELATIVE_RESOLUTION * RELATIVE_RESOLUTION * dot3(y, y));
    double trace = C[0] + C[4] + C[8];
    add_to_diagonal(C, RESOLUTION_M * RESOLUTION_M + fmin(MIN_SHARE * trace, MOST_SHARE_M2));
}

/* y = o + d + exp(psi) e^s p of a point, where its sensor was, and its stated covariance. */
static void calibrated_point(const Seen *seen, long i, const double turned[9], int is_planar,
                             double y[3], double origin[3], double stated[9]) {
    const double *arm = seen->arms + 3 * i;
    for (int b = 0; b < 3; b++)
        origin[b] = seen->origins ? seen->origins[3 * i + b] : 0.0;
    if (seen->covariances)
        memcpy(stated, seen->covariances + 9 * i, 9 * sizeof(double));
    if (seen->sensor == NULL) {
        for (int b = 0; b < 3; b++)
            y[b] = arm[b] + origin[b];
        return;
    }
    turn(turned, arm, y);
    for (int b = 0; b < 3; b++) {
        origin[b] += seen->sensor[3 + b];
        y[b] += origin[b];
    }
    if (is_planar) { /* the line of sight keeps its height */
        origin[2] -= y[2];
        y[2] = 0.0;
    }
    if (seen->covariances)
        turned_covariance(turned, seen->covariances + 9 * i, stated);
}

/* D = R (-hat(l) J(psi), I, l) on k axes, of a point at l from the sensor. */
static void fill_sensitivity(const FilterState *x, const Seen *seen, const double R_hat[9],
                             const double J[9], const double l[3], double *D) {
    double of_all[21], column[3], turned[3];
    sensor_matrix(J, l, 7, of_all);
    memset(D, 0, (size_t)(x->k * x->c) * sizeof(double));
    for (long j = 0; j < seen->c_s; j++) {
        for (int b = 0; b < 3; b++)
            column[b] = of_all[7 * b + seen->of_sensor[j]];
        turn(R_hat, column, turned);
        for (int b = 0; b < x->k; b++)
            D[b * x->c + seen->column + j] = turned[b];
    }
}

/* By how much the noise of a landmark's points grows, as its errors last since it was seen. */
static double repetition_factor(const Landmarks *table, i64 row, i64 stamp_ns,
                                double error_time_s) {
    i64 last_ns = table->last_seen_ns[row];
    if (last_ns == stamp_ns) /* by another sensor */
        last_ns = table->seen_before_ns[row];
    if (last_ns < 0 || error_time_s == 0.0)
        return 1.0;
    double fresh = -expm1(-larger(seconds(stamp_ns, last_ns), MIN_INTERVAL_S) / error_time_s);
    return (2.0 - fresh) / fresh;
}

/* Whether a landmark, with further rejections, is surer than a point seen. */
static int is_sure(const Landmarks *table, i64 row, i64 further, const Limits *limits) {
    i64 count = table->counts[row], needed = limits->max_rejections;
    needed = count < needed ? count + 1 : needed;
    return count >= limits->confirmations && table->rejections[row] < needed - further;
}

/* Rows (k, width) of a point along the estimated axes as they are along what is measured of it.
 * Rows of what is not measured are zero: with a variance of 1 they say nothing. */
static void measure(const double *directions, int k, double *rows, long width, long stride) {
    for (long j = 0; j < width; j++) {
        double along[3] = {0.0};
        for (int b = 0; b < k; b++)
            for (int t = 0; t < k; t++)
                along[b] += directions[k * b + t] * rows[t * stride + j];
        for (int b = 0; b < k; b++)
            rows[b * stride + j] = along[b];
    }
}

/* The same of all points' rows (M, width). */
static void measure_rows(const Residuals *res, double *rows, long width, long stride) {
    int k = res->k;
    for (long i = 0; i < res->m && res->has_halves; i++)
        measure(res->directions + k * k * i, k, rows + k * i * stride, width, stride);
}

static void measure_columns(const Residuals *res, double *square) { /* of a matrix (M, M) */
    for (long i = 0; i < res->M; i++)
        measure_rows(res, square + i * res->M, 1, 1);
}

static int is_measured(const Residuals *res, long entry) {
    return !res->has_halves || !is_zero(res->directions + res->k * entry, res->k);
}

/* The directions of a point of ``seen``, on k axes of the reference frame, and r and R by them. */
static void fill_measured(const Pose *pose, const double seen[9], Residuals *res, long i) {
    int k = res->k;
    double in_reference[9], *directions = res->directions + k * k * i, *R = res->R + k * k * i;
    times_transposed(seen, pose->R, in_reference);
    for (int b = 0; b < k; b++)
        memcpy(directions + k * b, in_reference + 3 * b, (size_t)k * sizeof(double));
    measure(directions, k, res->r + k * i, 1, 1);
    measure(directions, k, R, k, k);
    for (int b = 0; b < k; b++)
        measure(directions, k, R + k * b, 1, 1);
    for (int b = 0; b < k; b++)
        R[(k + 1) * b] += !is_measured(res, k * i + b);
}

/* (29)  e_i = A y_i - a_i,  r_i = e_i - y_i°; 0 where a stamp is none. Of those that passed the gate
 * if that has been judged, else of all, whose weights begin with 0. */
static int fill_residuals(const FilterState *x, const Landmarks *table, const Seen *seen,
                          const PointFigures *figures, const Limits *limits, const Observed *out,
                          int is_judged, Residuals *res) {
    Pose pose = pose_of(x->A);
    double turned[9] = {0.0}, J[9] = {0.0};
    int k = x->k;
    long i = 0;
    res->has_sensor = (seen->sensor != NULL && seen->c_s > 0) || seen->D != NULL;
    res->has_halves = seen->directions != NULL;
    if (seen->sensor != NULL) {
        exp_and_jacobian(seen->sensor, turned, J);
        for (int e = 0; e < 9; e++)
            turned[e] *= exp(seen->sensor[6]);
    }
    for (long j = 0; j < seen->m; j++) {
        i64 row = seen->rows[j];
        double *y = out->points + 3 * j, *r = out->r + 3 * j, *origin = out->origins + 3 * j;
        double *stated = res->stated + 9 * j, expected[3], arm[3], line[3], C[9];
        calibrated_point(seen, j, turned, x->is_planar, y, origin, stated);
        if (is_judged && out->weights[j] == 0.0)
            continue;
        out->weights[j] = is_judged, out->repeated[j] = 1.0;
        memset(r, 0, 3 * sizeof(double));
        if (row < 0)
            continue;
        if (!is_stamp(table->last_seen_ns[row]) || !is_stamp(table->seen_before_ns[row]))
            return 0;
        turn(pose.R, y, r);
        for (int b = 0; b < 3; b++) {
            double point = x->y_ref[3 * row + b] + x->a[3 * row + b];
            res->points[3 * i + b] = point;
            r[b] += pose.x[b] - point;
        }
        seen_from(&pose, res->points + 3 * i, expected);
        /* The noise at the range where a landmark should be, in the measured direction. */
        for (int b = 0; b < 3; b++) {
            arm[b] = y[b] - origin[b];
            expected[b] -= origin[b];
        }
        const double *towards = is_sure(table, row, 0, limits) ? expected : arm;
        double measured = larger(dot3(arm, arm), RESOLUTION_M * RESOLUTION_M);
        double stretch = sqrt(dot3(towards, towards) / measured);
        for (int b = 0; b < 3; b++)
            line[b] = stretch * arm[b];
        stated_covariance(y, seen->covariances ? stated : NULL, line, figures, C);
        double in_reference[9];
        turned_covariance(pose.R, C, in_reference);
        for (int b = 0; b < k; b++) {
            res->off[k * i + b] = res->r[k * i + b] = r[b];
            for (int t = 0; t < k; t++)
                res->R[k * k * i + k * b + t] = in_reference[3 * b + t];
        }
        if (seen->directions)
            fill_measured(&pose, seen->directions + 9 * j, res, i);
        if (seen->sensor != NULL && seen->c_s > 0)
            fill_sensitivity(x, seen, pose.R, J, expected, res->D + k * x->c * i);
        else if (seen->D != NULL)
            memcpy(res->D + k * x->c * i, seen->D + 3 * x->c * j,
                   (size_t)(k * x->c) * sizeof(double));
        out->repeated[j] = res->repeated[i] =
            repetition_factor(table, row, seen->stamp_ns, limits->error_time_s);
        res->rows[i] = row, res->at[i++] = j;
    }
    res->m = i, res->M = k * i;
    return 1;
}

static const double *of_landmark(const FilterState *x, const Residuals *res, long entry) {
    long column = x->first + x->stride * (long)res->rows[entry / x->k] + entry % x->k;
    return x->P + column * x->room; /* by symmetry, its column as well */
}

static double at_landmark(const FilterState *x, const Residuals *res, const double *row, long j) {
    return row[x->first + x->stride * (long)res->rows[j / x->k] + j % x->k];
}

static void with_noise(const Residuals *res, const double *predicted, const double *factors,
                       const double *weights, double *S) { /* + R times factors over weights */
    int k = res->k;
    memcpy(S, predicted, (size_t)(res->M * res->M) * sizeof(double));
    for (long i = 0; i < res->m; i++) {
        double grown = (factors ? factors[i] : 1.0) / (weights ? weights[i] : 1.0);
        for (int b = 0; b < k; b++)
            for (int t = 0; t < k; t++)
                S[(k * i + b) * res->M + k * i + t] += grown * res->R[k * k * i + k * b + t];
    }
}

/* C of r_i = C_i (eps, c) - xi_i, ``chord`` of the way from the landmark to the point seen. In an
 * exact map xi_i = [y_i]x eps_turn, which is a part of C_i then. */
static void fill_output(const FilterState *x, double chord, Residuals *res) {
    int k = res->k;
    memset(res->C, 0, (size_t)(res->M * res->q) * sizeof(double));
    for (long i = 0; i < res->m; i++) {
        double from[3] = {0.0}, *C = res->C + k * i * res->q;
        for (int b = 0; b < 3; b++)
            from[b] = (b < k ? chord * res->off[k * i + b] : 0.0)
                      + (x->stride ? 0.0 : res->points[3 * i + b]);
        output_matrix(from, x->p, C, res->q);
        for (int b = 0; b < k && res->has_sensor; b++)
            memcpy(C + b * res->q + x->p, res->D + (k * i + b) * x->c,
                   (size_t)x->c * sizeof(double));
    }
}

/* predicted = C P C', with C in the middle between the landmark and the point seen: turning moves
 * at right angles to it. */
static void fill_predicted(const FilterState *x, Residuals *res) {
    long M = res->M, q = res->q;
    fill_output(x, 0.5, res);
    for (long i = 0; i < M; i++) {
        const double *C = res->C + i * q, *own = x->stride ? of_landmark(x, res, i) : NULL;
        double *half = res->half, *T = res->T + i * q;
        for (long t = 0; t < q; t++) {
            T[t] = own ? own[t] : 0.0;
            half[t] = -T[t];
            for (long u = 0; u < q; u++)
                half[t] += C[u] * x->P[u * x->room + t];
        }
        for (long j = 0; j <= i; j++) {
            const double *C_j = res->C + j * q, *T_j = res->T + j * q;
            double sum = own ? at_landmark(x, res, own, j) : 0.0;
            for (long t = 0; t < q; t++)
                sum += half[t] * C_j[t] - C[t] * T_j[t];
            res->predicted[i * M + j] = res->predicted[j * M + i] = sum;
        }
    }
    measure_rows(res, res->predicted, M, M);
    measure_columns(res, res->predicted);
}

/* L, S = L L', in place, z = L^-1 r and S^-1 r, which may be one; 0 where S is indefinite. */
static int solve(const Residuals *res, double *S, double *z, double *S_inv_r) {
    size_t size = (size_t)res->M * sizeof(double);
    if (!factor(S, res->M))
        return 0;
    memcpy(z, res->r, size);
    solve_lower(S, res->M, z);
    memmove(S_inv_r, z, size);
    solve_upper(S, res->M, S_inv_r);
    return 1;
}

/* S = C P C' + R of the points, and its factor; 0 where S is indefinite. */
static int predict(const FilterState *x, Residuals *res) {
    fill_predicted(x, res);
    with_noise(res, res->predicted, NULL, NULL, res->S);
    memcpy(res->L, res->S, (size_t)(res->M * res->M) * sizeof(double));
    return solve(res, res->L, res->z, res->S_inv_r);
}

/* Which points pass the gate, weights 1; how many, or -1 where S is indefinite. */
static long judge(const FilterState *x, const Seen *seen, double gate, const Observed *out,
                  Residuals *res) {
    long passed = res->m, of_all = seen->m;
    int k = res->k;
    if (!predict(x, res))
        return -1;
    /* No residual is further out than all of them together are. */
    int all_pass = sum_of_squares(res->z, res->M) <= gate * gate;
    for (long i = 0; i < res->m; i++)
        out->weights[res->at[i]] = 1.0;
    for (long i = 0; i < res->m && (!all_pass || out->judges); i++) {
        double square = squared_distance(res->r, res->S, res->M, k * i, k);
        if (out->judges) {
            out->judged[res->at[i]] = sqrt(larger(square, 0.0));
            out->judged[of_all + res->at[i]] = -INFINITY;
            out->judged[2 * of_all + res->at[i]] = 1.0 / res->repeated[i];
        }
        if (!all_pass && !(square >= 0.0 && sqrt(square) <= gate)) {
            out->weights[res->at[i]] = 0.0;
            passed--;
        }
    }
    return passed;
}

/* The density of each residual given those before it, and all together. */
static void write_densities(const Residuals *res, long of_all, double *judged) {
    int k = res->k;
    for (long i = 0; i < res->m; i++) {
        double sum = 0.0;
        for (long e = k * i; e < k * (i + 1); e++)
            sum += 0.5 * res->z[e] * res->z[e] + log(res->L[e * res->M + e])
                   + (is_measured(res, e) ? LOG_ROOT_2_PI : 0.0);
        judged[of_all + res->at[i]] = -sum;
    }
    judged[3 * of_all] = sum_of_squares(res->z, res->M);
}

/* g and F of motion_noise.py, from u = C' S^-1 r and G = C' S^-1 C. */
static void score(const double *u, const double *G, const double *N, int p, double squared,
                  double rare, double g[2], double F[4]) {
    double NG[2][36], weight = smaller(1.0, rare / larger(squared, 1.0));
    for (int j = 0; j < 2; j++) {
        double moved = 0.0, trace = 0.0;
        for (int s = 0; s < p; s++)
            for (int t = 0; t < p; t++) {
                const double *row = N + p * p * j + p * s;
                moved += u[s] * row[t] * u[t];
                NG[j][p * s + t] = 0.0;
                for (int q = 0; q < p; q++)
                    NG[j][p * s + t] += row[q] * G[p * q + t];
            }
        for (int s = 0; s < p; s++)
            trace += NG[j][p * s + s];
        g[j] = 0.5 * (weight * moved - trace);
    }
    for (int j = 0; j < 2; j++)
        for (int l = 0; l < 2; l++) {
            double sum = 0.0;
            for (int s = 0; s < p; s++)
                for (int t = 0; t < p; t++)
                    sum += NG[j][p * s + t] * NG[l][p * t + s];
            F[2 * j + l] = 0.5 * sum;
        }
}

/* The logarithms and their information after an observation of g and F. */
static void step_factors(const Factors *factors, const double g[2], const double F[4],
                         double logs[2], double information[4]) {
    double right[2], change[2], kept = 1.0 - 1.0 / MEMORY;
    for (int j = 0; j < 4; j++)
        information[j] = kept * factors->information[j] + F[j];
    for (int j = 0; j < 2; j++)
        right[j] = g[j] - factors->logs[j] / MEMORY;
    double a = information[0] + 1.0, d = information[3] + 1.0;
    double determinant = a * d - information[1] * information[2];
    change[0] = (d * right[0] - information[1] * right[1]) / determinant;
    change[1] = (a * right[1] - information[2] * right[0]) / determinant;
    for (int j = 0; j < 2; j++) {
        double log = factors->logs[j] + smaller(larger(change[j], -MAX_STEP), MAX_STEP);
        logs[j] = smaller(larger(log, LEAST_LOGARITHM), LARGEST_LOGARITHM);
    }
}

/* What these residuals say of the noise of the motion, by S as the likelihood at the logarithms
 * has it, which may be less than is applied; 0 if it is indefinite. ``work``: M (M + p + 1), and
 * ``at``: 2 M. */
static int learn(const FilterState *x, const Factors *factors, double gate, const Residuals *res,
                 double *work, i64 *at, double logs[2], double information[4]) {
    int p = x->p, k = res->k;
    i64 *kept = at + res->M;
    double N[72], change[36] = {0.0}, u[6] = {0.0}, G[36] = {0.0}, g[2], F[4];
    double *L = work, *Y = L + res->M * res->M, *z = Y + res->M * p, squared;
    for (int j = 0; j < 2; j++) {
        double ratio = exp(factors->logs[j]) / factors->applied[j];
        for (int e = 0; e < p * p; e++) {
            N[p * p * j + e] = ratio * factors->shares[p * p * j + e];
            change[e] += N[p * p * j + e] - factors->shares[p * p * j + e];
        }
    }
    long M = res->M, passed; /* entries ``at`` of the residuals: at first all */
    for (long i = 0; i < M; i++)
        at[i] = i;
    for (;;) {
        for (long i = 0; i < M; i += k) { /* C in the middle between expected and seen */
            double middle[3];
            for (int b = 0; b < 3; b++)
                middle[b] = res->points[3 * (at[i] / k) + b]
                            + (b < k ? 0.5 * res->off[at[i] + b] : 0.0);
            output_matrix(middle, p, Y + i * p, p);
            if (res->has_halves)
                measure(res->directions + k * at[i], k, Y + i * p, p, p);
        }
        for (long i = 0; i < M; i++) {
            double half[6] = {0.0};
            for (int s = 0; s < p; s++)
                for (int t = 0; t < p; t++)
                    half[t] += Y[i * p + s] * change[p * s + t];
            for (long j = 0; j < M; j++) {
                L[i * M + j] = res->S[at[i] * res->M + at[j]];
                for (int t = 0; t < p; t++)
                    L[i * M + j] += half[t] * Y[j * p + t];
            }
            z[i] = res->r[at[i]];
        }
        passed = 0;
        for (long i = 0; i < M; i += k) {
            double square = squared_distance(z, L, M, i, k);
            for (int b = 0; b < k && square >= 0.0 && sqrt(square) <= gate; b++)
                kept[passed++] = at[i + b];
        }
        if (!factor(L, M))
            return 0;
        solve_lower(L, M, z);
        squared = sum_of_squares(z, M);
        if (squared <= gate * gate || 2 * passed <= M || passed == M)
            break;
        M = passed; /* some few are left out */
        memcpy(at, kept, (size_t)M * sizeof(i64));
    }
    solve_lower_rows(L, M, Y, p, p);
    for (long i = 0; i < M; i++)
        for (int s = 0; s < p; s++) {
            u[s] += Y[i * p + s] * z[i];
            for (int t = 0; t < p; t++)
                G[p * s + t] += Y[i * p + s] * Y[i * p + t];
        }
    long measured = 0;
    for (long i = 0; i < M; i++)
        measured += is_measured(res, at[i]);
    double root = sqrt(2.0 * (double)measured - 1.0) + RARE;
    score(u, G, N, p, squared, 0.5 * root * root, g, F);
    step_factors(factors, g, F, logs, information);
    return 1;
}

/* Huber's weights of what the correction leaves, R S^-1 r. ``work``: M (M + 1). */
static int fill_weights(double huber, Residuals *res, double *work) {
    long M = res->M;
    int k = res->k;
    double *L = work, *s = work + M * M;
    for (long i = 0; i < res->m; i++)
        res->weights[i] = 1.0;
    memcpy(s, res->S_inv_r, (size_t)M * sizeof(double));
    for (int round = 0; round < REWEIGHTINGS && huber != 0.0; round++) {
        int all_count = 1;
        if (round) {
            with_noise(res, res->predicted, NULL, res->weights, L);
            if (!solve(res, L, s, s))
                return 0;
        }
        for (long i = 0; i < res->m; i++) {
            double square = 0.0;
            for (int b = 0; b < k; b++)
                for (int t = 0; t < k; t++)
                    square += s[k * i + b] * res->R[k * k * i + k * b + t] * s[k * i + t];
            res->weights[i] = huber / larger(sqrt(square) / res->weights[i], huber);
            all_count &= res->weights[i] == 1.0;
        }
        if (all_count)
            break;
    }
    return 1;
}

/* Whether S = L L' has a pivot that is next to nothing of the entry it began with, or P - W' W a
 * variance, but for the postponed ones: then the rest has no digits. */
static int loses_digits(const FilterState *x, const Residuals *res, const double *L) {
    for (long i = 0; i < res->M; i++) {
        const double *row = L + i * res->M;
        double pivot = row[i] * row[i];
        if (pivot < LOST * (pivot + sum_of_squares(row, i)))
            return 1;
    }
    for (long j = 0; j < x->N; j++) {
        double before = x->P[j * x->room + j], left = before;
        for (long i = 0; i < res->M; i++)
            left -= res->W[i * x->N + j] * res->W[i * x->N + j];
        if (left < LOST * before && (j < x->p + x->c || j >= x->first))
            return 1;
    }
    return 0;
}

/* (30), (31)  dx = -K r, K = P H' S^-1, and P - K H P; 0 if S is indefinite, or digits are lost.
 * H takes C at the landmark itself: so no observation says anything of the gauge. */
static int correct(const FilterState *x, Residuals *res, double *L) {
    long M = res->M, N = x->N, q = x->p + (res->has_sensor ? x->c : 0);
    fill_output(x, 0.0, res);
    for (long i = 0; i < M; i++) { /* H P */
        double *row = res->W + i * N;
        const double *own = x->stride ? of_landmark(x, res, i) : NULL;
        for (long j = 0; j < N; j++)
            row[j] = own ? -own[j] : 0.0;
        for (long t = 0; t < q; t++) {
            double share = res->C[i * res->q + t];
            const double *of_t = x->P + t * x->room;
            for (long j = 0; j < N && share != 0.0; j++)
                row[j] += share * of_t[j];
        }
    }
    measure_rows(res, res->W, N, N);
    for (long i = 0; i < M; i++) /* H P H' */
        for (long j = 0; j < M; j++) {
            const double *row = res->W + i * N, *C = res->C + j * res->q;
            double sum = x->stride ? -at_landmark(x, res, row, j) : 0.0;
            for (long t = 0; t < q; t++)
                sum += C[t] * row[t];
            res->predicted[i * M + j] = sum;
        }
    measure_columns(res, res->predicted);
    with_noise(res, res->predicted, res->repeated, res->weights, L);
    if (!factor(L, M))
        return 0;
    /* W = L^-1 H P:  P - W' W,  K r = W' L^-1 r */
    double *z = res->S_inv_r;
    memcpy(z, res->r, (size_t)M * sizeof(double));
    solve_lower(L, M, z);
    solve_lower_rows(L, M, res->W, N, N);
    if (loses_digits(x, res, L))
        return 0;
    for (long i = 0; i < M; i++)
        for (long j = 0; j < N; j++)
            res->dx[j] -= z[i] * res->W[i * N + j];
    add_product(x->P, x->room, N, res->W, res->W, N, M, -1.0);
    mirror(x->P, x->room, N);
    return 1;
}

/* (28)  X <- exp(dx) X:  A <- exp(eps) A,  y_i <- exp(eps_turn) y_i + J(eps_turn) xi_i */
static void move(const FilterState *x, const double *dx, const Observed *out) {
    double twist[6] = {0.0}, J[9];
    memcpy(twist + x->pose, dx, (size_t)x->p * sizeof(double));
    Pose before = pose_of(x->A), D, after;
    exp_and_jacobian(twist, D.R, J);
    turn(J, twist + 3, D.x);
    after = composed(&D, &before);
    write_pose(&after, out->A);
    for (long i = 0; i < x->n && x->stride; i++) {
        const double *y_ref = x->y_ref + 3 * i;
        double *a = x->a + 3 * i, xi[3] = {0.0}, moved[3], turned[3], turned_a[3];
        memcpy(xi, dx + x->first + x->stride * i, (size_t)x->k * sizeof(double));
        turn(J, xi, moved);
        turn(D.R, y_ref, turned);
        turn(D.R, a, turned_a);
        for (int b = 0; b < 3; b++)
            a[b] = turned_a[b] + (moved[b] + (turned[b] - y_ref[b]));
    }
    memcpy(out->moved, dx, (size_t)x->N * sizeof(double));
}

/* Note which landmarks were seen, and where they should have been by the corrected state. */
static void record(const FilterState *x, const Landmarks *table, const Seen *seen,
                   const PointFigures *figures, const Limits *limits, const Observed *out,
                   const Residuals *res) {
    Pose pose = pose_of(out->A);
    for (long j = 0; j < seen->m; j++) {
        i64 row = seen->rows[j], is_used = out->weights[j] > 0.0;
        if (is_used) {
            table->counts[row] += 1;
            table->rejections[row] = 0;
        }
        if (is_used && table->last_seen_ns[row] < seen->stamp_ns) {
            table->seen_before_ns[row] = table->last_seen_ns[row];
            table->last_seen_ns[row] = seen->stamp_ns;
        }
        double point[3], expected[3], *line = out->lines_of_sight + 3 * j;
        memcpy(expected, out->points + 3 * j, sizeof expected);
        if (row >= 0 && is_sure(table, row, !is_used, limits)) {
            for (int b = 0; b < 3; b++)
                point[b] = x->y_ref[3 * row + b] + x->a[3 * row + b];
            seen_from(&pose, point, expected);
        }
        for (int b = 0; b < 3; b++)
            line[b] = expected[b] - out->origins[3 * j + b];
        if (seen->covariances)
            stated_covariance(out->points + 3 * j, res->stated + 9 * j, line, figures,
                              out->covariances + 9 * j);
    }
}

/* Move X by the innovation (28)-(31), and P with it, by all points that pass the gate. */
static int observe(const FilterState *x, const Landmarks *table, const Seen *seen,
                   const PointFigures *figures, const Limits *limits, const Factors *factors,
                   const Observed *out) {
    if (!is_stamp(seen->stamp_ns))
        return UNUSUAL;
    long m = 0;
    for (long j = 0; j < seen->m; j++)
        m += seen->rows[j] >= 0;
    Residuals res;
    size_t numbers = lay_out(&res, x, m, seen->m, NULL), M = (size_t)res.M;
    size_t work_size = M * (M + (size_t)x->p + 1);
    double *memory = PyMem_Malloc((numbers + work_size + 2 * M + 2 * (size_t)m) * sizeof(double));
    if (memory == NULL)
        return UNUSUAL;
    lay_out(&res, x, m, seen->m, memory);
    double *work = memory + numbers, logs[2], information[4];
    i64 *at = (i64 *)(work + work_size); /* 8 bytes each, as numbers are */
    res.rows = at + 2 * M, res.at = res.rows + m;
    int status = UNUSUAL;
    if (fill_residuals(x, table, seen, figures, limits, out, 0, &res)) {
        long passed = m ? judge(x, seen, limits->gate, out, &res) : 0;
        status = passed < 0 ? UNUSUAL : limits->may_refuse && 2 * passed < m ? REJECTS : DONE;
        if (status == DONE && m && factors->are_there
            && !learn(x, factors, limits->gate, &res, work, at, logs, information))
            status = UNUSUAL;
        if (status == DONE && passed < m) {
            fill_residuals(x, table, seen, figures, limits, out, 1, &res);
            status = predict(x, &res) ? DONE : UNUSUAL;
        }
        if (status == DONE && out->judges && res.m)
            write_densities(&res, seen->m, out->judged);
    }
    memset(res.dx, 0, (size_t)x->N * sizeof(double));
    if (status == DONE && res.m && !(fill_weights(limits->huber, &res, work)
                                     && correct(x, &res, work)))
        status = UNUSUAL;
    if (status == DONE) {
        for (int j = 0; j < 2 && m && factors->are_there; j++) {
            factors->logs[j] = logs[j];
            memcpy(factors->information + 2 * j, information + 2 * j, 2 * sizeof(double));
            if (factors->least < INFINITY)
                factors->applied[j] = exp(larger(logs[j], factors->least));
        }
        move(x, res.dx, out);
        for (long i = 0; i < res.m; i++)
            out->weights[res.at[i]] = res.weights[i];
        record(x, table, seen, figures, limits, out, &res);
    }
    PyMem_Free(memory);
    return status;
}

/* ---------------------------------------------------------------------------------- the module */

static PyObject *py_advance(PyObject *Py_UNUSED(self), PyObject *const *args, Py_ssize_t count) {
    Door door;
    FilterState x;
    Velocities velocities;
    Interval interval;
    MotionFigures figures;
    Advanced out;
    int status = UNUSUAL;
    open_door(&door);
    if (count != 5)
        refuse("advance");
    else if (read_estimate(&door, args[0], &x)
             && read_fields(&door, args[1], VELOCITIES, &velocities, "Velocities")
             && read_fields(&door, args[2], INTERVAL, &interval, "Interval")
             && read_fields(&door, args[3], MOTION_FIGURES, &figures, "MotionFigures")
             && read_fields(&door, args[4], ADVANCED, &out, "Advanced")) {
        velocities.count = (long)door.sizes['r'];
        status = advance(&x, &velocities, &interval, &figures, &out);
    }
    close_door(&door);
    return PyErr_Occurred() ? NULL : PyLong_FromLong(status);
}

static PyObject *py_observe(PyObject *Py_UNUSED(self), PyObject *const *args, Py_ssize_t count) {
    Door door;
    FilterState x;
    Landmarks table;
    Seen seen;
    PointFigures figures;
    Limits limits;
    Factors factors;
    Observed out;
    int status = UNUSUAL;
    open_door(&door);
    factors.are_there = count == 7 && args[5] != Py_None;
    if (count != 7)
        refuse("observe");
    else if (read_estimate(&door, args[0], &x)
             && read_fields(&door, args[1], LANDMARKS, &table, "Landmarks")
             && read_seen(&door, args[2], &x, &seen)
             && read_fields(&door, args[3], POINT_FIGURES, &figures, "PointFigures")
             && read_fields(&door, args[4], LIMITS, &limits, "Limits")
             && (!factors.are_there || read_fields(&door, args[5], FACTORS, &factors, "Factors"))
             && read_observed(&door, args[6], &out))
        status = observe(&x, &table, &seen, &figures, &limits, &factors, &out);
    close_door(&door);
    return PyErr_Occurred() ? NULL : PyLong_FromLong(status);
}

static PyMethodDef methods[] = {
    METHOD("advance", py_advance, "As step.advance."),
    METHOD("observe", py_observe, "As step.observe."),
    {NULL, NULL, 0, NULL},
};

MODULE(_core, "The step in C.")
