/* The gas generator: its rates, and its discrete step of eq. (12). */
#include "gas.h"

static void outputs(Unit *u, const double *y)
{
  int i;
  for (i = 0; i < N_Y; i++)
    u->v[AT_Y + i] = y[Y_OF[i]];
}

int model_start(Unit *u)
{
  double theta[G_THETA];
  gas_numbers(u->v + AT_P, theta);
  return unit_call(u, gas_similar, IN(u->v + AT_X, u->v + AT_U, theta), OUT(u->z));
}

int model_evaluate(Unit *u)
{
  double theta[G_THETA], y[G_Y];
  gas_numbers(u->v + AT_P, theta);
  int status =
    unit_call(u, gas_evaluate, IN(u->v + AT_X, u->v + AT_U, theta), OUT(u->v + AT_D, y));
  if (status == FINE)
    status = gas_check(u, y[G_RESIDUAL], y);
  if (status == FINE)
    outputs(u, y);
  return status;
}

int model_switch(Unit *u)
{
  (void)u;
  return FINE;
}

int model_step(Unit *u, double h)
{
  double theta[G_THETA], y[G_Y], x[N_X], z[N_Z], residual;
  gas_numbers(u->v + AT_P, theta);
  int status = unit_call(u, gas_step, IN(u->v + AT_X, u->v + AT_U, theta, &h, u->z),
                         OUT(x, y, z, &residual));
  if (status == FINE)
    status = gas_check(u, residual, y);
  if (status == FINE) {
    int i;
    for (i = 0; i < N_X; i++)
      u->v[AT_X + i] = x[i];
    for (i = 0; i < N_Z; i++)
      u->z[i] = z[i];
    outputs(u, y);
  }
  return status;
}
