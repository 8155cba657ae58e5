/* The generator with its exciter and load. */
#include "machine.h"
#include "radau.h"

static int outputs(Unit *u, const double *x)
{
  double y[M_Y];
  const int status = machine_outputs(u, 0, x, y);
  int i;
  for (i = 0; i < N_Y && status == FINE; i++)
    u->v[AT_Y + i] = y[Y_OF[i]];
  return status;
}

int model_start(Unit *u)
{
  u->machine[0].step = FIRST;
  machine_turn(u, 0, u->v[AT_U]);
  return FINE;
}

int model_evaluate(Unit *u)
{
  double x[M_X], rates[M_X];
  int i, status;
  machine_turn(u, 0, u->v[AT_U]);
  machine_pick(u, 0, x);
  status = machine_rates(u, 0, x, rates);
  for (i = 0; i < N_X; i++)
    u->v[AT_D + i] = 0.0;
  machine_put(u, 0, rates, AT_D);
  return status == FINE ? outputs(u, x) : status;
}

int model_switch(Unit *u)
{
  machine_turn(u, 0, u->v[AT_U]);
  machine_reset(u, 0);
  u->machine[0].step = FIRST;
  return FINE;
}

int model_step(Unit *u, double h)
{
  double x[M_X];
  int status;
  machine_pick(u, 0, x);
  status = radau(u, 0, x, h, u->means[0]);
  if (status == FINE)
    machine_put(u, 0, x, AT_X);
  return status == FINE ? outputs(u, x) : status;
}
