/* Generators: two sets of equations each, healthy and faulty, on one set of states.

   Where the fault's first parameter is zero the machine is healthy: the states of the fault rest
   at zero, as they start from zero when the fault comes, or when it moves to another phase. */
#include "machine.h"

#include <string.h>

#define OWN(u, k, what) MACHINES[k].what[(u)->machine[k].faulty]

/* Take speed, inputs and fault. */
void machine_turn(Unit *u, int k, double w_r)
{
  const Equations *e = &MACHINES[k];
  const double *fault = u->v + AT_P + e->p;
  Machine *m = &u->machine[k];
  const int was = m->faulty;
  double given[M_GIVEN];
  int n = 0;
  memset(m->u, 0, sizeof m->u);
  m->u[0] = w_r;
  memcpy(m->u + 1, u->v + AT_U + e->u, (size_t)e->n_inputs * sizeof(double));
  m->faulty = fault[0] > 0.0;
  if (e->axis >= 0) {
    m->moved = m->moved || (was && m->faulty && m->axis != fault[e->axis]);
    m->axis = fault[e->axis];
  }
  if (m->faulty)
    for (; n < e->n_fault; n++)
      given[n] = fault[n];
  memcpy(given + n, e->numbers, (size_t)e->n_numbers * sizeof(double));
  unit_call(u, OWN(u, k, follow), IN(given), OUT(m->theta));
  m->moved = m->moved || was != m->faulty;
}

/* Let the states of a fault begin at zero where it has come, gone or moved. */
void machine_reset(Unit *u, int k)
{
  int i;
  for (i = 0; u->machine[k].moved && i < MACHINES[k].n_reset; i++)
    u->v[AT_X + MACHINES[k].x + MACHINES[k].reset[i]] = 0.0;
  u->machine[k].moved = 0;
}

int machine_size(const Unit *u, int k) { return OWN(u, k, size); }

static int place(const Unit *u, int k, int i)
{
  return u->machine[k].faulty ? i : MACHINES[k].healthy[i];
}

void machine_pick(const Unit *u, int k, double *own)
{
  int i;
  for (i = 0; i < machine_size(u, k); i++)
    own[i] = u->v[AT_X + MACHINES[k].x + place(u, k, i)];
}

void machine_put(Unit *u, int k, const double *own, int first)
{
  int i;
  for (i = 0; i < machine_size(u, k); i++)
    u->v[first + MACHINES[k].x + place(u, k, i)] = own[i];
}

double machine_nominal(const Unit *u, int k, int i) { return MACHINES[k].nominal[place(u, k, i)]; }

int machine_rates(Unit *u, int k, const double *x, double *rates)
{
  const Machine *m = &u->machine[k];
  return unit_call(u, OWN(u, k, f), IN(x, m->u, m->theta), OUT(rates));
}

int machine_outputs(Unit *u, int k, const double *x, double *y)
{
  const Machine *m = &u->machine[k];
  return unit_call(u, OWN(u, k, g), IN(x, m->u, m->theta), OUT(y));
}

int machine_jacobian(Unit *u, int k, const double *x, double *J)
{
  const Machine *m = &u->machine[k];
  return unit_call(u, OWN(u, k, jacobian), IN(x, m->u, m->theta), OUT(J));
}
