/* The generator: two sets of equations, healthy and faulty, on one set of states.

   Where the fault's first parameter is zero the machine is healthy: the states of the fault rest
   at zero, as they start from zero when the fault comes, or when it moves to another phase. */
#include "machine.h"

#include <string.h>

#define PICK(u, faulty_, healthy_) ((u)->machine.faulty ? (faulty_) : (healthy_))

/* Take speed, inputs (without speed) and fault; returns 1 if states of the fault are to be reset. */
int machine_set(Unit *u, double w_r, const double *inputs, const double *fault)
{
  Machine *m = &u->machine;
  const int was = m->faulty;
  double given[M_GIVEN];
  int moved = 0;
  memset(m->u, 0, sizeof m->u);
  m->u[0] = w_r;
  memcpy(m->u + 1, inputs, M_INPUTS * sizeof(double));
  m->faulty = fault[0] > 0.0;
  if (M_AXIS >= 0) {
    moved = was && m->faulty && m->axis != fault[M_AXIS < 0 ? 0 : M_AXIS];
    m->axis = fault[M_AXIS < 0 ? 0 : M_AXIS];
  }
  if (m->faulty)
    memcpy(given, fault, M_FAULT * sizeof(double));
  memcpy(given + (m->faulty ? M_FAULT : 0), M_NUMBERS, N_MACHINE * sizeof(double));
  unit_call(u, PICK(u, faulty_follow, healthy_follow), IN(given), OUT(m->theta));
  return was != m->faulty || moved;
}

int machine_size(const Unit *u) { return PICK(u, M_X, M_XH); }

void machine_pick(const Unit *u, const double *all, double *own)
{
  int i;
  for (i = 0; i < machine_size(u); i++)
    own[i] = all[PICK(u, i, M_AT[i])];
}

void machine_put(const Unit *u, const double *own, double *all)
{
  int i;
  for (i = 0; i < machine_size(u); i++)
    all[PICK(u, i, M_AT[i])] = own[i];
}

double machine_nominal(const Unit *u, int i) { (void)u; return M_NOMINAL[PICK(u, i, M_AT[i])]; }

int machine_rates(Unit *u, const double *x, double *rates)
{
  return unit_call(u, PICK(u, faulty_f, healthy_f), IN(x, u->machine.u, u->machine.theta),
                   OUT(rates));
}

int machine_outputs(Unit *u, const double *x, double *y)
{
  return unit_call(u, PICK(u, faulty_g, healthy_g), IN(x, u->machine.u, u->machine.theta), OUT(y));
}

int machine_jacobian(Unit *u, const double *x, double *J)
{
  return unit_call(u, PICK(u, faulty_jac, healthy_jac), IN(x, u->machine.u, u->machine.theta),
                   OUT(J));
}
