/* The whole unit.  Co-simulation: the generators over an exchange step at constant speed, then
   their mean power and the governor's fuel drive the gas generator's step (the paper, eqs. 1-3).
   Model exchange: speed, power and fuel of the very instant, nothing exchanged. */
#include <math.h>
#include <string.h>

#include "gas.h"
#include "machine.h"
#include "radau.h"

enum { AT_GOVERNOR = AT_X + 1, AT_TUNED = AT_P + N_P - N_TUNED };

/* Take speed, inputs and faults. */
static void turn(Unit *u)
{
  double w_r[N_GENERATORS];
  int k;
  unit_call(u, link_speed, IN(u->v + AT_X), OUT(w_r));
  for (k = 0; k < N_GENERATORS; k++)
    machine_turn(u, k, w_r[k]);
}

/* Outputs: of the gas generator, power of all generators, then each with the means that are
   known; P is the power of two such generators. */
static void outputs(Unit *u, double *y, const double *P)
{
  int i;
  y[G_Y] = 0.0;
  for (i = 0; i < N_GENERATORS; i++)
    y[G_Y] += P[i] / 2.0;
  for (i = 0; i < N_Y; i++)
    u->v[AT_Y + i] = y[Y_OF[i]];
}

/* Whether generator k does what the earlier one does that it equals. */
static int same(const Unit *u, int k)
{
  const Equations *e = &MACHINES[k], *o = &MACHINES[e->like];
  const Machine *m = &u->machine[k], *n = &u->machine[e->like];
  return e->like < k && m->faulty == n->faulty && m->step == n->step &&
         !memcmp(m->u, n->u, sizeof m->u) && !memcmp(m->theta, n->theta, sizeof m->theta) &&
         !memcmp(u->v + AT_X + e->x, u->v + AT_X + o->x, (size_t)e->size[1] * sizeof(double));
}

int model_start(Unit *u)
{
  int k;
  for (k = 0; k < N_GENERATORS; k++)
    u->machine[k].step = FIRST;
  return FINE;
}

int model_evaluate(Unit *u)
{
  double x[M_X], rates[M_X], y[N_RAW], theta[G_THETA], in[2 + N_AMBIENT], P[N_GENERATORS];
  double *D = u->v + AT_D;
  int status = FINE, i, k;
  turn(u);
  for (i = 0; i < N_X; i++)
    D[i] = 0.0;
  for (k = 0; k < N_GENERATORS && status == FINE; k++) {
    machine_pick(u, k, x);
    status = machine_rates(u, k, x, rates);
    machine_put(u, k, rates, AT_D);
    if (status == FINE)
      status = machine_outputs(u, k, x, y + MACHINES[k].y);
    P[k] = y[MACHINES[k].y + MACHINES[k].means[0]];
  }
  if (status == FINE)
    status = unit_call(u, link_now, IN(u->v + AT_X, u->v + AT_GOVERNOR, P, u->v + AT_TUNED),
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
    outputs(u, y, P);
  return status;
}

int model_switch(Unit *u)
{
  int k;
  turn(u);
  for (k = 0; k < N_GENERATORS; k++)
    machine_reset(u, k);
  return model_start(u);
}

int model_step(Unit *u, double h)
{
  double x[M_X], y[N_RAW], theta[G_THETA], after[1 + N_GOVERNOR], z[N_Z], residual;
  double P[N_GENERATORS], states[N_X];
  int status = FINE, i, k, like[N_GENERATORS];
  turn(u);
  for (k = 0; k < N_GENERATORS; k++)
    like[k] = same(u, k) ? MACHINES[k].like : k;
  for (k = 0; k < N_GENERATORS && status == FINE; k++) {
    const Equations *e = &MACHINES[k];
    const int first = like[k];
    if (first == k) {
      machine_pick(u, k, x);
      status = radau(u, k, x, h, u->means[k]);
      machine_put(u, k, x, AT_X);
      if (status == FINE)
        status = machine_outputs(u, k, x, y + e->y);
      /* small, so that its cosine stays accurate over hours */
      u->v[AT_X + e->x + e->angle] = remainder(u->v[AT_X + e->x + e->angle], 6.283185307179586);
    } else {
      memcpy(states, u->v + AT_X + MACHINES[first].x, (size_t)e->size[1] * sizeof(double));
      memcpy(u->v + AT_X + e->x, states, (size_t)e->size[1] * sizeof(double));
      memcpy(y + e->y, y + MACHINES[first].y, (size_t)e->n_outputs * sizeof(double));
      memcpy(u->means[k], u->means[first], sizeof u->means[k]);
      u->machine[k] = u->machine[first];
    }
    for (i = 0; i < N_MEANS; i++)
      y[e->y + e->means[i]] = u->means[k][i];
    P[k] = u->means[k][0];
  }
  if (status != FINE)
    return status;
  gas_numbers(u->v + AT_P, theta);
  status = unit_call(u, exchange,
                     IN(u->v + AT_X, u->v + AT_GOVERNOR, P, u->v + AT_U, theta, u->v + AT_TUNED,
                        &h, u->z),
                     OUT(after, after + 1, y, z, &residual));
  if (status == FINE)
    status = gas_check(u, residual, y);
  if (status != FINE)
    return status;
  memcpy(u->z, z, sizeof z);
  memcpy(u->v + AT_X, after, sizeof after);
  outputs(u, y, P);
  return FINE;
}
