#ifndef GAS_H
#define GAS_H
#include "unit.h"

/* Health factors and the engine's numbers, as its functions take them. */
void gas_numbers(const double *health, double *theta);
/* Whether a result of the cycle is one: solved, and its exit not choked. */
int gas_check(Unit *u, double residual, const double *y);

#endif
