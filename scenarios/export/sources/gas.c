/* What is told of the cycle's results. */
#include "gas.h"

#include <string.h>

void gas_numbers(const double *health, double *theta)
{
  memcpy(theta, health, G_HEALTH * sizeof(double));
  memcpy(theta + G_HEALTH, G_NUMBERS, N_ENGINE * sizeof(double));
}

int gas_check(Unit *u, double residual, const double *y)
{
  if (!(residual <= RESIDUAL_TOL))
    return unit_tell(u, DISCARD,
                     "the cycle is not solved, residual %g: probably beyond surge or off the maps",
                     residual);
  if (y[G_MACH8] > 1.0)
    return unit_tell(u, DISCARD, "exhaust exit choked, Mach %g: it is modelled subsonic only",
                     y[G_MACH8]);
  return FINE;
}
