#ifndef MACHINE_H
#define MACHINE_H
#include "unit.h"

/* The generator without or with its fault, on the states of the faulty one. */
int machine_set(Unit *u, double w_r, const double *inputs, const double *fault);
int machine_size(const Unit *u);
double machine_nominal(const Unit *u, int i);
int machine_rates(Unit *u, const double *x, double *rates);
int machine_outputs(Unit *u, const double *x, double *y);
int machine_jacobian(Unit *u, const double *x, double *J);
/* Between all states and those of the equations that hold. */
void machine_pick(const Unit *u, const double *all, double *own);
void machine_put(const Unit *u, const double *own, double *all);

#endif
