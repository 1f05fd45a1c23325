/* Vectors, 3 x 3 matrices, poses and small Cholesky factors, for all that is compiled. */
#ifndef SLAM_OBSERVER_LINEAR_H
#define SLAM_OBSERVER_LINEAR_H

#include <math.h>
#include <string.h>

static const double ZERO_GUARD = 1e-300; /* so3.py: 0/0 becomes 0 / 1e-300 */

static inline double larger(double a, double b) { return a > b ? a : b; }
static inline double smaller(double a, double b) { return a < b ? a : b; }

/* ------------------------------------------------------------------ vectors and 3 x 3 matrices */

static inline double dot3(const double *a, const double *b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static inline void hat(const double w[3], double K[9]) { /* (7)  K v = w x v */
    K[0] = K[4] = K[8] = 0.0;
    K[1] = -w[2], K[2] = w[1];
    K[3] = w[2], K[5] = -w[0];
    K[6] = -w[1], K[7] = w[0];
}

/* C, [-hat(y), I] on the d axes that are estimated, of rows ``stride`` long: how a pose error moves
 * a point at y. In the plane it is 2 x 3, in space 3 x 6. */
static inline void output_matrix(const double y[3], long d, double *C, long stride) {
    long k = d == 3 ? 2 : 3, turns = d - k, pose = d == 3 ? 2 : 0;
    double K[9];
    hat(y, K);
    for (long b = 0; b < k; b++) {
        for (long s = 0; s < turns; s++)
            C[b * stride + s] = -K[3 * b + pose + s];
        for (long s = turns; s < d; s++)
            C[b * stride + s] = s - turns == b ? 1.0 : 0.0;
    }
}

static inline void times(const double A[9], const double B[9], double C[9]) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            C[3 * i + j] = A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j];
}

static inline void times_transposed(const double A[9], const double B[9], double C[9]) { /* A B' */
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            C[3 * i + j] = dot3(A + 3 * i, B + 3 * j);
}

static inline void turn(const double R[9], const double v[3], double out[3]) { /* R v */
    for (int i = 0; i < 3; i++)
        out[i] = dot3(R + 3 * i, v);
}

static inline void turn_back(const double R[9], const double v[3], double out[3]) { /* R' v */
    for (int i = 0; i < 3; i++)
        out[i] = R[i] * v[0] + R[3 + i] * v[1] + R[6 + i] * v[2];
}

static inline void turned_covariance(const double R[9], const double C[9], double out[9]) { /* R C R' */
    double half[9];
    times(R, C, half);
    times_transposed(half, R, out);
}

/* exp(w) (Rodrigues) and the left Jacobian J, both polynomials in K = hat(w): so3.py */
static inline void exp_and_jacobian(const double w[3], double R[9], double J[9]) {
    double square = dot3(w, w) + ZERO_GUARD, half_angle = 0.5 * sqrt(square);
    double ratio = sin(half_angle) / half_angle;
    double a = ratio * cos(half_angle), b = 0.5 * ratio * ratio, c = (1.0 - a) / square;
    double K[9], K2[9];
    hat(w, K);
    times(K, K, K2);
    for (int i = 0; i < 9; i++) {
        double identity = i % 4 == 0 ? 1.0 : 0.0;
        R[i] = identity + a * K[i] + b * K2[i];
        J[i] = identity + b * K[i] + c * K2[i];
    }
}

static inline void normalise(double R[9]) { /* R (3 I - R' R) / 2 */
    double G[9], whole[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            G[3 * i + j] = (i == j ? 3.0 : 0.0)
                           - (R[i] * R[j] + R[3 + i] * R[3 + j] + R[6 + i] * R[6 + j]);
    times(R, G, whole);
    for (int i = 0; i < 9; i++)
        R[i] = 0.5 * whole[i];
}

typedef struct {
    double R[9], x[3];
} Pose;

static inline Pose pose_of(const double A[16]) {
    Pose pose;
    for (int i = 0; i < 3; i++) {
        memcpy(pose.R + 3 * i, A + 4 * i, 3 * sizeof(double));
        pose.x[i] = A[4 * i + 3];
    }
    return pose;
}

static inline void write_pose(const Pose *pose, double A[16]) {
    for (int i = 0; i < 3; i++) {
        memcpy(A + 4 * i, pose->R + 3 * i, 3 * sizeof(double));
        A[4 * i + 3] = pose->x[i];
    }
    A[12] = A[13] = A[14] = 0.0;
    A[15] = 1.0;
}

/* ---------------------------------------------- Cholesky factors L of n x n matrices, in place */

static inline int factor(double *S, long n) { /* returns 0 where S is not positive definite */
    for (long j = 0; j < n; j++) {
        double *row = S + j * n, square = row[j];
        for (long l = 0; l < j; l++)
            square -= row[l] * row[l];
        if (!(square > 0.0))
            return 0;
        row[j] = sqrt(square);
        for (long i = j + 1; i < n; i++) {
            double *below = S + i * n, sum = below[j];
            for (long l = 0; l < j; l++)
                sum -= below[l] * row[l];
            below[j] = sum / row[j];
        }
    }
    return 1;
}

static inline void solve_lower(const double *L, long n, double *b) { /* L^-1 b */
    for (long i = 0; i < n; i++) {
        for (long l = 0; l < i; l++)
            b[i] -= L[i * n + l] * b[l];
        b[i] /= L[i * n + i];
    }
}

static inline void solve_upper(const double *L, long n, double *b) { /* L'^-1 b */
    for (long i = n - 1; i >= 0; i--) {
        b[i] /= L[i * n + i];
        for (long l = 0; l < i; l++)
            b[l] -= L[i * n + l] * b[i];
    }
}

/* L^-1 B, of which each row has ``width`` entries */
static inline void solve_lower_rows(const double *L, long n, double *B, long width, long stride) {
    for (long i = 0; i < n; i++) {
        double *row = B + i * stride, inverse = 1.0 / L[i * n + i];
        for (long l = 0; l < i; l++) {
            const double *above = B + l * stride, share = L[i * n + l];
            for (long j = 0; j < width; j++)
                row[j] -= share * above[j];
        }
        for (long j = 0; j < width; j++)
            row[j] *= inverse;
    }
}

static inline double sum_of_squares(const double *z, long n) {
    double sum = 0.0;
    for (long i = 0; i < n; i++)
        sum += z[i] * z[i];
    return sum;
}

/* The squared Mahalanobis distance of the k entries of r (n) from i on, by their covariance in S
 * (n x n); -1 if that is indefinite. */
static inline double squared_distance(const double *r, const double *S, long n, long i, int k) {
    double L[9], z[3];
    for (int b = 0; b < k; b++)
        memcpy(L + b * k, S + (i + b) * n + i, (size_t)k * sizeof(double));
    memcpy(z, r + i, (size_t)k * sizeof(double));
    if (!factor(L, k))
        return -1.0;
    solve_lower(L, k, z);
    return sum_of_squares(z, k);
}

#endif
