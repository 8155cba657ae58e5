/* The generator with its exciter and load. */
#include "machine.h"
#include "radau.h"

static const double *fault(const Unit *u) { return u->v + AT_P; }

static int outputs(Unit *u, const double *x)
{
  double y[M_Y];
  const int status = machine_outputs(u, x, y);
  int i;
  for (i = 0; i < N_Y && status == FINE; i++)
    u->v[AT_Y + i] = y[Y_OF[i]];
  return status;
}

int model_start(Unit *u)
{
  u->machine.step = FIRST;
  machine_set(u, u->v[AT_U], u->v + AT_U + 1, fault(u));
  return FINE;
}

int model_evaluate(Unit *u)
{
  double x[M_X], rates[M_X];
  int i, status;
  machine_set(u, u->v[AT_U], u->v + AT_U + 1, fault(u));
  machine_pick(u, u->v + AT_X, x);
  status = machine_rates(u, x, rates);
  for (i = 0; i < N_X; i++)
    u->v[AT_D + i] = 0.0;
  machine_put(u, rates, u->v + AT_D);
  return status == FINE ? outputs(u, x) : status;
}

int model_switch(Unit *u)
{
  if (machine_set(u, u->v[AT_U], u->v + AT_U + 1, fault(u))) {
    int i;
    for (i = 0; i < N_RESET; i++)
      u->v[AT_X + RESET[i]] = 0.0;
  }
  u->machine.step = FIRST < u->machine.step ? FIRST : u->machine.step;
  return FINE;
}

int model_step(Unit *u, double h)
{
  double x[M_X];
  int status;
  machine_pick(u, u->v + AT_X, x);
  status = radau(u, x, h, u->means);
  if (status == FINE)
    machine_put(u, x, u->v + AT_X);
  return status == FINE ? outputs(u, x) : status;
}
