/* The whole unit.  Co-simulation: the generators over an exchange step at constant speed, then
   their mean power and the governor's fuel drive the gas generator's step (the paper, eqs. 1-3).
   Model exchange: speed, power and fuel of the very instant, nothing exchanged. */
#include <math.h>
#include <string.h>

#include "gas.h"
#include "machine.h"
#include "radau.h"

enum {
  AT_GOVERNOR = AT_X + 1,
  AT_MACHINE = AT_GOVERNOR + N_GOVERNOR,
  AT_FAULT = AT_P + G_HEALTH,
  AT_LINK = AT_FAULT + M_FAULT
};

static int turn(Unit *u)
{
  double w_r;
  unit_call(u, link_speed, IN(u->v + AT_X, u->v + AT_LINK), OUT(&w_r));
  return machine_set(u, w_r, u->v + AT_U + N_AMBIENT, u->v + AT_FAULT);
}

/* Outputs: of the gas generator, then of the generator, with the means that are known. */
static void outputs(Unit *u, const double *y)
{
  int i;
  for (i = 0; i < N_Y; i++)
    u->v[AT_Y + i] = y[Y_OF[i]];
}

int model_start(Unit *u)
{
  u->machine.step = FIRST;
  return FINE;
}

int model_evaluate(Unit *u)
{
  double x[M_X], rates[M_X], y[G_Y + M_Y], theta[G_THETA], in[2 + N_AMBIENT];
  double *y_machine = y + G_Y, *D = u->v + AT_D;
  int status, i;
  turn(u);
  machine_pick(u, u->v + AT_MACHINE, x);
  for (i = 0; i < N_X; i++)
    D[i] = 0.0;
  status = machine_rates(u, x, rates);
  machine_put(u, rates, D + AT_MACHINE - AT_X);
  if (status == FINE)
    status = machine_outputs(u, x, y_machine);
  if (status == FINE)
    status = unit_call(u, link_now,
                       IN(u->v + AT_X, u->v + AT_GOVERNOR, y_machine + MEAN_OF[0], u->v + AT_LINK),
                       OUT(in, D + AT_GOVERNOR - AT_X));
  if (status != FINE)
    return status;
  memcpy(in + 2, u->v + AT_U, N_AMBIENT * sizeof(double));
  gas_numbers(u->v + AT_P, theta);
  status = unit_call(u, gas_evaluate, IN(u->v + AT_X, in, theta), OUT(D, y));
  if (status == FINE && u->phase == INITIAL)
    status = unit_call(u, gas_similar, IN(u->v + AT_X, in, theta), OUT(u->z));
  if (status == FINE)
    status = gas_check(u, y[G_RESIDUAL], y);
  if (status == FINE)
    outputs(u, y);
  return status;
}

int model_switch(Unit *u)
{
  if (turn(u)) {
    int i;
    for (i = 0; i < N_RESET; i++)
      u->v[AT_MACHINE + RESET[i]] = 0.0;
  }
  u->machine.step = FIRST < u->machine.step ? FIRST : u->machine.step;
  return FINE;
}

int model_step(Unit *u, double h)
{
  double x[M_X], y[G_Y + M_Y], theta[G_THETA], after[1 + N_GOVERNOR], z[N_Z], residual;
  double angle;
  int status, i;
  turn(u);
  machine_pick(u, u->v + AT_MACHINE, x);
  status = radau(u, x, h, u->means);
  if (status != FINE)
    return status;
  gas_numbers(u->v + AT_P, theta);
  status = unit_call(u, exchange,
                     IN(u->v + AT_X, u->v + AT_GOVERNOR, u->means, u->v + AT_U, theta,
                        u->v + AT_LINK, &h, u->z),
                     OUT(after, after + 1, y, z, &residual));
  if (status == FINE)
    status = gas_check(u, residual, y);
  if (status == FINE)
    status = machine_outputs(u, x, y + G_Y);
  if (status != FINE)
    return status;
  for (i = 0; i < N_MEANS; i++)
    y[G_Y + MEAN_OF[i]] = u->means[i];
  memcpy(u->z, z, sizeof z);
  memcpy(u->v + AT_X, after, sizeof after);
  machine_put(u, x, u->v + AT_MACHINE);
  /* small, so that its cosine stays accurate over hours */
  angle = u->v[AT_MACHINE + M_ANGLE];
  u->v[AT_MACHINE + M_ANGLE] = remainder(angle, 6.283185307179586);
  outputs(u, y);
  return FINE;
}
