#ifndef MACHINE_H
#define MACHINE_H
#include "unit.h"

/* Generator k without or with its fault, on the states of the faulty one. */
void machine_turn(Unit *u, int k, double w_r);
void machine_reset(Unit *u, int k);
int machine_size(const Unit *u, int k);
double machine_nominal(const Unit *u, int k, int i);
int machine_rates(Unit *u, int k, const double *x, double *rates);
int machine_outputs(Unit *u, int k, const double *x, double *y);
int machine_jacobian(Unit *u, int k, const double *x, double *J);
/* From all variables to the states of the equations that hold, and back to states or rates. */
void machine_pick(const Unit *u, int k, double *own);
void machine_put(Unit *u, int k, const double *own, int first);

#endif
