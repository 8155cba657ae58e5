/* Radau IIA collocation with simplified Newton iterations and control of the step.

   Hairer, Wanner, Solving Ordinary Differential Equations II, sections IV.5 to IV.8.  With the
   stages Z = X - x0 and the Jacobian J at the start of a step,

     (A^-1 / h) Z = f(x0 + Z),    A^-1 = T diag(lambda) T^-1,

   so that Newton's method solves one real system and one complex one for each pair of eigenvalues.
   The error is that of an embedded formula one step of f more (IV.8.19), filtered by the real
   system.  Means are exact for the collocation polynomial's stages.  Nodes and coefficients, of
   any odd number of stages, are made with the export (model.h). */
#include "radau.h"

#include <math.h>
#include <string.h>

#include "machine.h"

enum { MOST = 12 }; /* Newton iterations */

/* LU of a complex matrix without its rows exchanged in place, column by column. */
static int factor(int n, double *a, double *b, int *row)
{
  int i, j, k;
  for (k = 0; k < n; k++) {
    int p = k;
    double best = 0.0, d;
    for (i = k; i < n; i++) {
      const double size = fabs(a[i + n * k]) + fabs(b[i + n * k]);
      if (size > best) {
        best = size;
        p = i;
      }
    }
    row[k] = p;
    if (!(best > 0.0))
      return 1;
    if (p != k)
      for (j = 0; j < n; j++) {
        double s = a[k + n * j];
        a[k + n * j] = a[p + n * j];
        a[p + n * j] = s;
        s = b[k + n * j];
        b[k + n * j] = b[p + n * j];
        b[p + n * j] = s;
      }
    d = a[k + n * k] * a[k + n * k] + b[k + n * k] * b[k + n * k];
    for (i = k + 1; i < n; i++) {
      const double re = a[i + n * k], im = b[i + n * k];
      a[i + n * k] = (re * a[k + n * k] + im * b[k + n * k]) / d;
      b[i + n * k] = (im * a[k + n * k] - re * b[k + n * k]) / d;
    }
    for (j = k + 1; j < n; j++) {
      const double re = a[k + n * j], im = b[k + n * j];
      if (re != 0.0 || im != 0.0)
        for (i = k + 1; i < n; i++) {
          a[i + n * j] -= a[i + n * k] * re - b[i + n * k] * im;
          b[i + n * j] -= a[i + n * k] * im + b[i + n * k] * re;
        }
    }
  }
  return 0;
}

static void solve(int n, const double *a, const double *b, const int *row, double *x, double *y)
{
  int i, k;
  for (k = 0; k < n; k++) {
    const int p = row[k];
    double s = x[p];
    x[p] = x[k];
    x[k] = s;
    s = y[p];
    y[p] = y[k];
    y[k] = s;
  }
  for (k = 0; k < n; k++)
    for (i = k + 1; i < n; i++) {
      x[i] -= a[i + n * k] * x[k] - b[i + n * k] * y[k];
      y[i] -= a[i + n * k] * y[k] + b[i + n * k] * x[k];
    }
  for (k = n - 1; k >= 0; k--) {
    const double re = a[k + n * k], im = b[k + n * k], d = re * re + im * im;
    const double s = (x[k] * re + y[k] * im) / d;
    y[k] = (y[k] * re - x[k] * im) / d;
    x[k] = s;
    for (i = 0; i < k; i++) {
      x[i] -= a[i + n * k] * x[k] - b[i + n * k] * y[k];
      y[i] -= a[i + n * k] * y[k] + b[i + n * k] * x[k];
    }
  }
}

typedef struct {
  double a[M_X * M_X], b[M_X * M_X];
  int row[M_X];
} System;

/* Factor lambda/h - J for each eigenvalue. */
static int prepare(System *systems, int n, const double *J, double h)
{
  int k, i;
  for (k = 0; k <= R_PAIRS; k++) {
    System *s = &systems[k];
    for (i = 0; i < n * n; i++) {
      s->a[i] = -J[i];
      s->b[i] = 0.0;
    }
    for (i = 0; i < n; i++) {
      s->a[i + n * i] += R_RE[k] / h;
      s->b[i + n * i] = R_IM[k] / h;
    }
    if (factor(n, s->a, s->b, s->row))
      return 1;
  }
  return 0;
}

static double norm(int n, const double *e, const double *scale)
{
  double sum = 0.0;
  int i;
  for (i = 0; i < n; i++)
    sum += e[i] / scale[i] * (e[i] / scale[i]);
  return sqrt(sum / n);
}

/* Newton's iterations; Z and F at the end.  0: converged, 1: not, else a failure of f. */
static int stages(Unit *u, int machine, int n, const double *x, double h, const double *scale,
                  const System *systems, double Z[R_STAGES][M_X], double F[R_STAGES][M_X])
{
  double last = 0.0, rate = 1.0;
  int i, j, k, m;
  memset(Z, 0, R_STAGES * sizeof *Z);
  for (m = 0; m < MOST; m++) {
    double R[R_STAGES][M_X], D[R_STAGES][M_X], size = 0.0;
    for (j = 0; j < R_STAGES; j++) {
      double at[M_X];
      for (i = 0; i < n; i++)
        at[i] = x[i] + Z[j][i];
      if (machine_rates(u, machine, at, F[j]))
        return 2;
    }
    for (j = 0; j < R_STAGES; j++)
      for (i = 0; i < n; i++) {
        double s = F[j][i];
        for (k = 0; k < R_STAGES; k++)
          s -= R_INVERSE[j][k] / h * Z[k][i];
        R[j][i] = s;
      }
    memset(D, 0, sizeof D);
    for (k = 0; k <= R_PAIRS; k++) {
      double re[M_X], im[M_X];
      for (i = 0; i < n; i++) {
        re[i] = im[i] = 0.0;
        for (j = 0; j < R_STAGES; j++) {
          re[i] += R_TO_RE[k][j] * R[j][i];
          im[i] += R_TO_IM[k][j] * R[j][i];
        }
      }
      solve(n, systems[k].a, systems[k].b, systems[k].row, re, im);
      for (j = 0; j < R_STAGES; j++)
        for (i = 0; i < n; i++)
          D[j][i] += R_FROM_RE[j][k] * re[i] - R_FROM_IM[j][k] * im[i];
    }
    for (j = 0; j < R_STAGES; j++) {
      const double one = norm(n, D[j], scale);
      size = one > size ? one : size;
      for (i = 0; i < n; i++)
        Z[j][i] += D[j][i];
    }
    if (!isfinite(size))
      return 1;
    if (m > 0) {
      rate = size / last;
      if (rate >= 0.9 && size > 1e-9)
        return 1;
    }
    last = size;
    if (size < 1e-9 || (m > 0 && rate < 1.0 && rate / (1.0 - rate) * size < NEWTON_TOL))
      return 0;
  }
  return 1;
}

int radau(Unit *u, int machine, double *x, double length, double *means)
{
  static const double least = 1e-13; /* s */
  const int n = machine_size(u, machine);
  System systems[R_PAIRS + 1];
  double J[M_X * M_X], f0[M_X], scale[M_X], err[M_X], at[M_X], y[M_Y];
  double Z[R_STAGES][M_X], F[R_STAGES][M_X];
  double done = 0.0, h = u->machine[machine].step, made = 0.0;
  int i, j, fresh = 0, first = 1;
  for (i = 0; i < N_MEANS; i++)
    means[i] = 0.0;
  while (done < length) {
    double size;
    const double rest = length - done;
    int status, again;
    if (h > rest * (1.0 - 1e-9) || rest < 1e-12)
      h = rest;
    if (!fresh) {
      if (machine_jacobian(u, machine, x, J) || machine_rates(u, machine, x, f0))
        return DISCARD;
      for (i = 0; i < n; i++)
        scale[i] = TOLERANCE * (machine_nominal(u, machine, i) + fabs(x[i]));
      fresh = 1;
      made = 0.0;
    }
    if (h != made && prepare(systems, n, J, h))
      return unit_tell(u, DISCARD, "a step of %g s is singular", h);
    made = h;
    status = stages(u, machine, n, x, h, scale, systems, Z, F);
    if (status == 2)
      return DISCARD;
    if (status) {
      h *= 0.25;
      first = 1;
      if (h < least)
        return unit_tell(u, DISCARD, "the generator's equations need steps below %g s", least);
      continue;
    }
    for (again = 0;; again++) {
      double zero[M_X] = {0.0};
      const double *f = f0;
      if (again) {
        for (i = 0; i < n; i++)
          at[i] = x[i] + err[i];
        if (machine_rates(u, machine, at, zero))
          return DISCARD;
        f = zero;
      }
      for (i = 0; i < n; i++) {
        double s = h / R_RE[0] * f[i];
        for (j = 0; j < R_STAGES; j++)
          s += R_ERROR[j] * Z[j][i];
        err[i] = R_RE[0] / h * s;
      }
      memset(at, 0, sizeof at);
      solve(n, systems[0].a, systems[0].b, systems[0].row, err, at);
      size = norm(n, err, scale);
      if (size < 1.0 || !first || again)
        break;
    }
    if (size < 1.0) {
      for (j = 0; j < R_STAGES; j++) {
        for (i = 0; i < n; i++)
          at[i] = x[i] + Z[j][i];
        if (machine_outputs(u, machine, at, y))
          return DISCARD;
        for (i = 0; i < N_MEANS; i++)
          means[i] += h / length * R_WEIGHTS[j] * y[MACHINES[machine].means[i]];
      }
      for (i = 0; i < n; i++)
        x[i] += Z[R_STAGES - 1][i];
      done += h;
      fresh = first = 0;
      if (h == rest)
        done = length;
    } else
      first = 1;
    {
      double factor_ = 0.9 * pow(size > 1e-12 ? size : 1e-12, -1.0 / (R_STAGES + 1));
      factor_ = factor_ > 6.0 ? 6.0 : factor_ < 0.1 ? 0.1 : factor_;
      if (h < rest || size >= 1.0 || factor_ < 1.0)
        u->machine[machine].step = h * factor_;
      h = u->machine[machine].step;
    }
    if (!(h >= least))
      return unit_tell(u, DISCARD, "the generator's equations need steps below %g s", least);
  }
  return FINE;
}
