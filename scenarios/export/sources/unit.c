/* What all exported models share: variables, and the grid of their steps. */
#include "unit.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

void unit_reset(Unit *u)
{
  memset(u->v, 0, sizeof u->v);
  memcpy(u->v + AT_U, U_START, N_U * sizeof(double));
  memcpy(u->v + AT_P, P_START, N_P * sizeof(double));
  memcpy(u->v + AT_X, X_START, N_X * sizeof(double));
  memset(u->machine, 0, sizeof u->machine);
  memset(u->z, 0, sizeof u->z);
  u->start = 0.0;
  u->phase = INITIAL;
  u->stale = u->changed = 1;
}

/* Compute rates and outputs where they are not those of this instant. */
int unit_refresh(Unit *u)
{
  int status = FINE;
  if (u->stale && u->phase != STOPPED) {
    if (u->phase == INITIAL)
      status = model_start(u);
    if (status == FINE)
      status = model_evaluate(u);
    u->stale = status != FINE;
  }
  return status;
}

int unit_get(Unit *u, unsigned int at, double *value)
{
  if (at >= N_V)
    return unit_tell(u, WRONG, "no variable has the value reference %g", at);
  if (at >= AT_D) {
    int status = unit_refresh(u);
    if (status != FINE)
      return status;
  }
  *value = u->v[at];
  return FINE;
}

int unit_give(Unit *u, const double *from, double *to, size_t n, int fresh)
{
  const int status = fresh ? unit_refresh(u) : FINE;
  if (n != N_X)
    return WRONG;
  if (status == FINE)
    memcpy(to, from, n * sizeof(double));
  return status;
}

int unit_move(Unit *u, const double *x, size_t n)
{
  if (n != N_X)
    return WRONG;
  memcpy(u->v + AT_X, x, n * sizeof(double));
  u->stale = 1;
  return FINE;
}

int unit_set(Unit *u, unsigned int at, double value)
{
  if (at < AT_U || at >= AT_D)
    return unit_tell(u, WRONG, "the variable of the value reference %g cannot be set", at);
  if (at >= AT_X && !u->exchange && u->phase != INITIAL)
    return unit_tell(u, WRONG, "a state can be set before the start only (%g)", at);
  if (!isfinite(value))
    return unit_tell(u, WRONG, "a value is not finite: value reference %g", at);
  if (at < AT_P ? value < U_LEAST[at - AT_U] || value > U_MOST[at - AT_U]
                : at < AT_X && (value < P_LEAST[at - AT_P] || value > P_MOST[at - AT_P]))
    return unit_tell(u, WRONG, "a value is out of its range: value reference %g", at);
  if (u->v[at] != value && (u->exchange || u->phase == INITIAL))
    u->stale = 1;
  u->changed = u->changed || u->v[at] != value;
  u->v[at] = value;
  return FINE;
}

/* Go on by h from t: to each multiple of STEP, and to the end. */
int unit_advance(Unit *u, double t, double h)
{
  const double end = t + h, near = 1e-9;
  int status = u->changed ? model_switch(u) : FINE;
  u->changed = 0;
  while (status == FINE && t < end - near) {
    const double next = u->start + STEP * (floor((t - u->start) / STEP + near / STEP) + 1.0);
    const double until = next < end - near ? next : end;
    u->v[AT_TIME] = t;
    status = model_step(u, until - t);
    t = until;
  }
  u->v[AT_TIME] = t;
  u->stale = 0;
  return status;
}

/* Call a function of model.c with work space behind its arguments. */
int unit_call(Unit *u, Function f, const double *const *in, int n_in, double *const *out,
              int n_out)
{
  int i;
  for (i = 0; i < n_in; i++)
    u->arg[i] = in[i];
  for (i = 0; i < n_out; i++)
    u->res[i] = out[i];
  return f(u->arg, u->res, u->iw, u->w, 0) ? unit_tell(u, DISCARD, "evaluation failed", 0.0)
                                           : FINE;
}

int unit_tell(Unit *u, int status, const char *what, double value)
{
  char text[200], whole[300];
  snprintf(text, sizeof text, what, value);
  snprintf(whole, sizeof whole, "at t = %.6g s: %s", u->v[AT_TIME], text);
  host_message(u, status, whole);
  return status;
}
