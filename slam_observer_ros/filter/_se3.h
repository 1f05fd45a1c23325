/* SE(3) and its Jacobians, as se3.py and so3.py have them; twists have their angular part first. */
#ifndef SLAM_OBSERVER_SE3_H
#define SLAM_OBSERVER_SE3_H

#include "_linear.h"

static const double SERIES_BELOW = 0.1; /* se3.py */
static const double SERIES[6] = {1.0 / 6, -1.0 / 120, 1.0 / 5040, -1.0 / 362880, 1.0 / 39916800,
                                 -1.0 / 6227020800.0};

/* Through the quaternion (v, w), of which any multiple will do. */
static inline void log_of_rotation(const double R[9], double phi[3]) {
    double trace = R[0] + R[4] + R[8], skew[3] = {R[7] - R[5], R[2] - R[6], R[3] - R[1]};
    double diagonal[4] = {2 * R[0] + 1 - trace, 2 * R[4] + 1 - trace, 2 * R[8] + 1 - trace,
                          1 + trace};
    int row = 0;
    for (int j = 1; j < 4; j++)
        row = diagonal[j] > diagonal[row] ? j : row;
    double v[3], w = row == 3 ? diagonal[3] : skew[row];
    for (int j = 0; j < 3; j++)
        v[j] = row == 3 ? skew[j] : j == row ? diagonal[row] : R[3 * row + j] + R[3 * j + row];
    double sine = sqrt(dot3(v, v) + ZERO_GUARD), sign = w < 0.0 ? -1.0 : 1.0;
    double factor = sign * 2.0 * atan2(sine, fabs(w)) / sine;
    for (int j = 0; j < 3; j++)
        phi[j] = factor * v[j];
}

/* J^-1 = I - K / 2 + (1 - a / 2b) K^2 / theta^2 */
static inline void inverse_jacobian(const double phi[3], double J[9]) {
    double square = dot3(phi, phi) + ZERO_GUARD, half = 0.5 * sqrt(square);
    double factor = (1.0 - half * cos(half) / sin(half)) / square, K[9], K2[9];
    hat(phi, K);
    times(K, K, K2);
    for (int i = 0; i < 9; i++)
        J[i] = (i % 4 == 0 ? 1.0 : 0.0) - 0.5 * K[i] + factor * K2[i];
}

/* Q = b U + c (K U + U K) + (phi.v) (b' K + c' K^2), U = hat(v), primes for d/d(theta^2 / 2) */
static inline void coupling(const double xi[6], double Q[9]) {
    double square = dot3(xi, xi) + ZERO_GUARD, half = 0.5 * sqrt(square), ratio = sin(half) / half;
    double a = ratio * cos(half), b = 0.5 * ratio * ratio, c = (1.0 - a) / square;
    if (square < SERIES_BELOW)
        for (int i = 5, is_first = 1; i >= 0; i--, is_first = 0)
            c = is_first ? SERIES[i] : SERIES[i] + square * c;
    double along = dot3(xi, xi + 3), of_K = along * (a - 2.0 * b) / square;
    double of_K2 = along * (b - 3.0 * c) / square, K[9], U[9], KU[9], UK[9], K2[9];
    hat(xi, K);
    hat(xi + 3, U);
    times(K, U, KU);
    times(U, K, UK);
    times(K, K, K2);
    for (int i = 0; i < 9; i++)
        Q[i] = b * U[i] + c * (KU[i] + UK[i]) + of_K * K[i] + of_K2 * K2[i];
}

static inline void lower_triangular(const double D[9], const double L[9], double M[36]) {
    memset(M, 0, 36 * sizeof(double));
    for (int i = 0; i < 3; i++) {
        memcpy(M + 6 * i, D + 3 * i, 3 * sizeof(double));
        memcpy(M + 6 * (i + 3) + 3, D + 3 * i, 3 * sizeof(double));
        memcpy(M + 6 * (i + 3), L + 3 * i, 3 * sizeof(double));
    }
}

static inline void right_jacobian(const double xi[6], double J[36]) { /* the left one at -xi */
    double minus[6] = {-xi[0], -xi[1], -xi[2], -xi[3], -xi[4], -xi[5]}, R[9], D[9], Q[9];
    exp_and_jacobian(minus, R, D);
    coupling(minus, Q);
    lower_triangular(D, Q, J);
}

static inline void right_jacobian_inverse(const double xi[6], double J[36]) {
    double minus[6] = {-xi[0], -xi[1], -xi[2], -xi[3], -xi[4], -xi[5]};
    double D[9], Q[9], half[9], L[9];
    inverse_jacobian(minus, D);
    coupling(minus, Q);
    times(D, Q, half);
    times(half, D, L);
    for (int i = 0; i < 9; i++)
        L[i] = -L[i];
    lower_triangular(D, L, J);
}

static inline void adjoint(const Pose *T, double Ad[36]) { /* [[R, 0], [hat(x) R, R]] */
    double K[9], L[9];
    hat(T->x, K);
    times(K, T->R, L);
    lower_triangular(T->R, L, Ad);
}

static inline Pose exponential(const double xi[6]) {
    double J[9];
    Pose T;
    exp_and_jacobian(xi, T.R, J);
    turn(J, xi + 3, T.x);
    return T;
}

static inline void logarithm(const Pose *T, double xi[6]) {
    double J[9];
    log_of_rotation(T->R, xi);
    inverse_jacobian(xi, J);
    turn(J, T->x, xi + 3);
}

static inline Pose composed(const Pose *A, const Pose *B) { /* A B */
    Pose C;
    times(A->R, B->R, C.R);
    turn(A->R, B->x, C.x);
    for (int b = 0; b < 3; b++)
        C.x[b] += A->x[b];
    return C;
}

static inline Pose inverse_of(const Pose *T) {
    Pose inverse;
    double x[3];
    turn_back(T->R, T->x, x);
    for (int i = 0; i < 3; i++) {
        inverse.x[i] = -x[i];
        for (int j = 0; j < 3; j++)
            inverse.R[3 * i + j] = T->R[3 * j + i];
    }
    return inverse;
}

static inline Pose from_to(const Pose *A, const Pose *B) { /* A^-1 B */
    Pose back = inverse_of(A);
    return composed(&back, B);
}

/* D = [-hat(l) J(psi), I, l], 3 x 7: how a point at l from its sensor changes with that. */
static inline void sensor_matrix(const double J[9], const double l[3], int each, double *D) {
    double K[9], of_turn[9];
    hat(l, K);
    times(K, J, of_turn);
    for (int t = 0; t < 3; t++)
        for (int j = 0; j < 7; j++)
            D[each * t + j] = j < 3 ? -of_turn[3 * t + j] : j < 6 ? (double)(t == j - 3) : l[t];
}

static inline void seen_from(const Pose *T, const double p[3], double y[3]) { /* R' (p - x) */
    double arm[3] = {p[0] - T->x[0], p[1] - T->x[1], p[2] - T->x[2]};
    turn_back(T->R, arm, y);
}

#endif
