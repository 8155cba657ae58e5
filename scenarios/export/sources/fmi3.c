/* The functions of FMI 3.0 for model exchange and co-simulation. */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "unit.h"

#if defined _WIN32
#define FMI __declspec(dllexport)
#elif defined __GNUC__
#define FMI __attribute__((visibility("default")))
#else
#define FMI
#endif

typedef int Status;
typedef uint32_t Reference;
typedef void (*Log)(void *host, Status status, const char *category, const char *message);

void host_message(Unit *u, int status, const char *text)
{
  if (u->log) {
    Log log;
    memcpy(&log, &u->log, sizeof log);
    log(u->host, status, status == WRONG ? "logStatusError" : "logStatusDiscard", text);
  }
}

static void *instantiate(const char *token, bool exchange, void *host, Log log)
{
  Unit *u = calloc(1, sizeof *u);
  if (u == NULL)
    return NULL;
  u->host = host;
  memcpy(&u->log, &log, sizeof u->log);
  u->exchange = exchange;
  unit_reset(u);
  if (token == NULL || strcmp(token, TOKEN)) {
    unit_tell(u, WRONG, "the instantiation token is of another model description", 0.0);
    free(u);
    return NULL;
  }
  return u;
}

FMI const char *fmi3GetVersion(void) { return "3.0"; }

FMI Status fmi3SetDebugLogging(void *c, bool on, size_t n, const char *const categories[])
{
  (void)c; (void)on; (void)n; (void)categories;
  return FINE;
}

FMI void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *path,
                                       bool visible, bool logging, void *host, Log log)
{
  (void)name; (void)path; (void)visible; (void)logging;
  return instantiate(token, true, host, log);
}

FMI void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *path,
                                      bool visible, bool logging, bool events, bool early,
                                      const Reference intermediate[], size_t n, void *host,
                                      Log log, void *update)
{
  (void)name; (void)path; (void)visible; (void)logging; (void)events; (void)early;
  (void)intermediate; (void)n; (void)update;
  return instantiate(token, false, host, log);
}

FMI void *fmi3InstantiateScheduledExecution(const char *name, const char *token, const char *path,
                                            bool visible, bool logging, void *host, Log log,
                                            void *update, void *lock, void *unlock)
{
  (void)name; (void)token; (void)path; (void)visible; (void)logging; (void)host; (void)log;
  (void)update; (void)lock; (void)unlock;
  return NULL;
}

FMI void fmi3FreeInstance(void *c) { free(c); }

FMI Status fmi3EnterInitializationMode(void *c, bool defined, double tolerance, double start,
                                       bool stop_defined, double stop)
{
  Unit *u = c;
  (void)defined; (void)tolerance; (void)stop_defined; (void)stop;
  u->start = u->v[AT_TIME] = start;
  u->stale = 1;
  return FINE;
}

FMI Status fmi3ExitInitializationMode(void *c)
{
  Unit *u = c;
  const Status status = unit_refresh(u);
  u->phase = READY;
  return status == FINE ? FINE : WRONG;
}

FMI Status fmi3EnterEventMode(void *c) { (void)c; return FINE; }

FMI Status fmi3Terminate(void *c)
{
  Unit *u = c;
  u->phase = STOPPED;
  return FINE;
}

FMI Status fmi3Reset(void *c) { unit_reset(c); return FINE; }

FMI Status fmi3GetFloat64(void *c, const Reference at[], size_t n, double values[], size_t m)
{
  size_t i;
  for (i = 0; i < n && i < m; i++) {
    const Status status = unit_get(c, at[i], &values[i]);
    if (status != FINE)
      return status;
  }
  return n == m ? FINE : WRONG;
}

FMI Status fmi3SetFloat64(void *c, const Reference at[], size_t n, const double values[], size_t m)
{
  size_t i;
  for (i = 0; i < n && i < m; i++) {
    const Status status = unit_set(c, at[i], values[i]);
    if (status != FINE)
      return status;
  }
  return n == m ? FINE : WRONG;
}

/* There are no variables of other types. */
#define NONE(name, type)                                                                          \
  FMI Status fmi3Get##name(void *c, const Reference at[], size_t n, type values[], size_t m)      \
  {                                                                                               \
    (void)c; (void)at; (void)values; (void)m;                                                     \
    return n ? WRONG : FINE;                                                                      \
  }                                                                                               \
  FMI Status fmi3Set##name(void *c, const Reference at[], size_t n, const type values[], size_t m) \
  {                                                                                               \
    (void)c; (void)at; (void)values; (void)m;                                                     \
    return n ? WRONG : FINE;                                                                      \
  }
typedef const char *String;
NONE(Float32, float)
NONE(Int8, int8_t)
NONE(UInt8, uint8_t)
NONE(Int16, int16_t)
NONE(UInt16, uint16_t)
NONE(Int32, int32_t)
NONE(UInt32, uint32_t)
NONE(Int64, int64_t)
NONE(UInt64, uint64_t)
NONE(Boolean, bool)
NONE(String, String)

FMI Status fmi3GetBinary(void *c, const Reference at[], size_t n, size_t sizes[],
                         const uint8_t *values[], size_t m)
{
  (void)c; (void)at; (void)sizes; (void)values; (void)m;
  return n ? WRONG : FINE;
}

FMI Status fmi3SetBinary(void *c, const Reference at[], size_t n, const size_t sizes[],
                         const uint8_t *const values[], size_t m)
{
  (void)c; (void)at; (void)sizes; (void)values; (void)m;
  return n ? WRONG : FINE;
}

FMI Status fmi3GetClock(void *c, const Reference at[], size_t n, bool values[])
{
  (void)c; (void)at; (void)values;
  return n ? WRONG : FINE;
}

FMI Status fmi3SetClock(void *c, const Reference at[], size_t n, const bool values[])
{
  (void)c; (void)at; (void)values;
  return n ? WRONG : FINE;
}

FMI Status fmi3GetNumberOfVariableDependencies(void *c, Reference at, size_t *n)
{
  (void)c; (void)at; (void)n;
  return WRONG;
}

FMI Status fmi3GetVariableDependencies(void *c, Reference at, size_t of[], Reference on[],
                                       size_t elements[], int kinds[], size_t n)
{
  (void)c; (void)at; (void)of; (void)on; (void)elements; (void)kinds; (void)n;
  return WRONG;
}

FMI Status fmi3GetFMUState(void *c, void **state)
{
  if (*state == NULL)
    *state = malloc(sizeof(Unit));
  if (*state == NULL)
    return WRONG;
  memcpy(*state, c, sizeof(Unit));
  return FINE;
}

FMI Status fmi3SetFMUState(void *c, void *state)
{
  Unit *u = c;
  memcpy(u, state, offsetof(Unit, host));
  return FINE;
}

FMI Status fmi3FreeFMUState(void *c, void **state)
{
  (void)c;
  free(*state);
  *state = NULL;
  return FINE;
}

FMI Status fmi3SerializedFMUStateSize(void *c, void *state, size_t *size)
{
  (void)c; (void)state;
  *size = offsetof(Unit, host);
  return FINE;
}

FMI Status fmi3SerializeFMUState(void *c, void *state, uint8_t bytes[], size_t size)
{
  (void)c;
  if (size < offsetof(Unit, host))
    return WRONG;
  memcpy(bytes, state, offsetof(Unit, host));
  return FINE;
}

FMI Status fmi3DeserializeFMUState(void *c, const uint8_t bytes[], size_t size, void **state)
{
  if (size < offsetof(Unit, host) || fmi3GetFMUState(c, state) != FINE)
    return WRONG;
  memcpy(*state, bytes, offsetof(Unit, host));
  return FINE;
}

FMI Status fmi3GetDirectionalDerivative(void *c, const Reference unknowns[], size_t n,
                                        const Reference knowns[], size_t k, const double seed[],
                                        size_t ns, double sensitivity[], size_t nr)
{
  (void)c; (void)unknowns; (void)n; (void)knowns; (void)k; (void)seed; (void)ns;
  (void)sensitivity; (void)nr;
  return WRONG;
}

FMI Status fmi3GetAdjointDerivative(void *c, const Reference unknowns[], size_t n,
                                    const Reference knowns[], size_t k, const double seed[],
                                    size_t ns, double sensitivity[], size_t nr)
{
  return fmi3GetDirectionalDerivative(c, unknowns, n, knowns, k, seed, ns, sensitivity, nr);
}

FMI Status fmi3EnterConfigurationMode(void *c) { (void)c; return FINE; }
FMI Status fmi3ExitConfigurationMode(void *c) { (void)c; return FINE; }

/* There are no clocks. */
FMI Status fmi3GetIntervalDecimal(void *c, const Reference at[], size_t n, double i[], int q[])
{
  (void)c; (void)at; (void)i; (void)q;
  return n ? WRONG : FINE;
}

FMI Status fmi3GetIntervalFraction(void *c, const Reference at[], size_t n, uint64_t counters[],
                                   uint64_t resolutions[], int q[])
{
  (void)c; (void)at; (void)counters; (void)resolutions; (void)q;
  return n ? WRONG : FINE;
}

FMI Status fmi3GetShiftDecimal(void *c, const Reference at[], size_t n, double shifts[])
{
  (void)c; (void)at; (void)shifts;
  return n ? WRONG : FINE;
}

FMI Status fmi3GetShiftFraction(void *c, const Reference at[], size_t n, uint64_t counters[],
                                uint64_t resolutions[])
{
  (void)c; (void)at; (void)counters; (void)resolutions;
  return n ? WRONG : FINE;
}

FMI Status fmi3SetIntervalDecimal(void *c, const Reference at[], size_t n, const double i[])
{
  (void)c; (void)at; (void)i;
  return n ? WRONG : FINE;
}

FMI Status fmi3SetIntervalFraction(void *c, const Reference at[], size_t n,
                                   const uint64_t counters[], const uint64_t resolutions[])
{
  (void)c; (void)at; (void)counters; (void)resolutions;
  return n ? WRONG : FINE;
}

FMI Status fmi3SetShiftDecimal(void *c, const Reference at[], size_t n, const double shifts[])
{
  (void)c; (void)at; (void)shifts;
  return n ? WRONG : FINE;
}

FMI Status fmi3SetShiftFraction(void *c, const Reference at[], size_t n,
                                const uint64_t counters[], const uint64_t resolutions[])
{
  (void)c; (void)at; (void)counters; (void)resolutions;
  return n ? WRONG : FINE;
}

FMI Status fmi3ActivateModelPartition(void *c, Reference clock, double time)
{
  (void)c; (void)clock; (void)time;
  return WRONG;
}

FMI Status fmi3EvaluateDiscreteStates(void *c) { (void)c; return FINE; }

FMI Status fmi3UpdateDiscreteStates(void *c, bool *again, bool *terminate, bool *nominals,
                                    bool *values, bool *defined, double *next)
{
  Unit *u = c;
  double before[N_X];
  memcpy(before, u->v + AT_X, sizeof before);
  *again = *terminate = *nominals = *defined = false;
  *next = 0.0;
  model_switch(u);
  *values = memcmp(before, u->v + AT_X, sizeof before) != 0;
  u->stale = u->stale || *values;
  return FINE;
}

/* ------------------------------------------------------------------------- model exchange */

FMI Status fmi3EnterContinuousTimeMode(void *c) { (void)c; return FINE; }

FMI Status fmi3CompletedIntegratorStep(void *c, bool no_set, bool *event, bool *terminate)
{
  (void)c; (void)no_set;
  *event = *terminate = false;
  return FINE;
}

FMI Status fmi3SetTime(void *c, double time)
{
  Unit *u = c;
  u->v[AT_TIME] = time;
  return FINE;
}

FMI Status fmi3SetContinuousStates(void *c, const double x[], size_t n)
{
  return unit_move(c, x, n);
}

FMI Status fmi3GetContinuousStateDerivatives(void *c, double rates[], size_t n)
{
  return unit_give(c, ((Unit *)c)->v + AT_D, rates, n, 1);
}

FMI Status fmi3GetContinuousStates(void *c, double x[], size_t n)
{
  return unit_give(c, ((Unit *)c)->v + AT_X, x, n, 0);
}

FMI Status fmi3GetNominalsOfContinuousStates(void *c, double nominals[], size_t n)
{
  return unit_give(c, X_NOMINAL, nominals, n, 0);
}

FMI Status fmi3GetEventIndicators(void *c, double indicators[], size_t n)
{
  (void)c; (void)indicators;
  return n ? WRONG : FINE;
}

FMI Status fmi3GetNumberOfEventIndicators(void *c, size_t *n) { (void)c; *n = 0; return FINE; }
FMI Status fmi3GetNumberOfContinuousStates(void *c, size_t *n) { (void)c; *n = N_X; return FINE; }

/* ------------------------------------------------------------------------- co-simulation */

FMI Status fmi3EnterStepMode(void *c) { (void)c; return FINE; }

FMI Status fmi3GetOutputDerivatives(void *c, const Reference at[], size_t n, const int32_t orders[],
                                    double values[], size_t m)
{
  (void)c; (void)at; (void)orders; (void)values; (void)m;
  return n ? WRONG : FINE;
}

FMI Status fmi3DoStep(void *c, double t, double h, bool no_set, bool *event, bool *terminate,
                      bool *early, double *last)
{
  Unit *u = c;
  Status status;
  (void)no_set;
  *event = *terminate = *early = false;
  status = unit_advance(u, t, h);
  *last = status == FINE ? t + h : u->v[AT_TIME];
  return status == FINE ? FINE : WRONG;
}
