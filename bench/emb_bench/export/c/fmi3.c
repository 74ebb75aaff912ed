/* The brake behind the functions of FMI 3.0, co-simulation. No header of FMI is needed. */
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include "brake.c"

#if defined(FMI3_FUNCTION_PREFIX) && !defined(FMI3_OVERRIDE_FUNCTION_PREFIX) /* of sources that are linked */
#define JOINED(a, b) a##b
#define JOIN(a, b) JOINED(a, b)
#define NAME(name) JOIN(FMI3_FUNCTION_PREFIX, name)
#else
#define NAME(name) name
#endif
#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT
#pragma GCC diagnostic ignored "-Wunused-parameter" /* FMI names them all */
#endif
#define FMI(name) EXPORT status NAME(name)

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } status;
typedef const char *text;
typedef void (*logger)(void *environment, status found, text category, text message);
typedef struct {
  double time; /* it and what follows are the variables, in the order of their references */
  brake b;
  int running;
  void *environment;
  logger log;
} instance;
typedef uint32_t reference;

enum { J = 1, CURRENT = @current@, FIXED = CURRENT - 3, COUNT = CURRENT + 5 }; /* references; of FIXED on contact, start */
typedef char in_order[offsetof(instance, b.friction_torque) == (COUNT - 1) * sizeof(double) ? 1 : -1];

static status refuse(const instance *c, text message) {
  if (c && c->log) c->log(c->environment, ERROR, "logStatusError", message);
  return ERROR;
}

EXPORT text NAME(fmi3GetVersion)(void) { return "3.0"; }

FMI(fmi3SetDebugLogging)(instance *c, _Bool on, size_t n, const text categories[]) { return c ? OK : ERROR; }

EXPORT instance *NAME(fmi3InstantiateCoSimulation)(text name, text token, text resources, _Bool visible, _Bool logging,
                                                   _Bool events, _Bool early, const reference needed[], size_t count,
                                                   void *environment, logger log, void (*update)(void)) {
  const instance refused = {.environment = environment, .log = log};
  instance *c = NULL;
  if (!token || strcmp(token, "@token@")) refuse(&refused, "the token is that of another FMU");
  else if (events || count) refuse(&refused, "this FMU has neither an event mode nor intermediate variables");
  else if (!(c = calloc(1, sizeof *c))) refuse(&refused, "no memory");
  if (!c) return NULL;
  *c = refused;
  brake_init(&c->b);
  return c;
}

EXPORT void *NAME(fmi3InstantiateModelExchange)(text a, text b, text c, _Bool d, _Bool e, void *f, logger g) {
  return 0;
}
EXPORT void *NAME(fmi3InstantiateScheduledExecution)(text a, text b, text c, _Bool d, _Bool e, void *f, logger g,
                                                     void (*h)(void), void (*i)(void), void (*j)(void)) { return 0; }
EXPORT void NAME(fmi3FreeInstance)(instance *c) { free(c); }

FMI(fmi3EnterInitializationMode)(instance *c, _Bool given, double tolerance, double start, _Bool ends, double stop) {
  return c->time = start, OK;
}
FMI(fmi3ExitInitializationMode)(instance *c) { return c->running = 1, OK; }
FMI(fmi3Terminate)(instance *c) { return c ? OK : ERROR; }
FMI(fmi3Reset)(instance *c) { return c->running = 0, brake_init(&c->b), OK; }

FMI(fmi3GetFloat64)(instance *c, const reference v[], size_t n, double x[], size_t m) {
  for (size_t k = 0; k < n; k++) {
    if (v[k] >= COUNT || n != m) return refuse(c, "no such variable");
    x[k] = ((const double *)c)[v[k]];
  }
  return OK;
}
FMI(fmi3SetFloat64)(instance *c, const reference v[], size_t n, const double x[], size_t m) {
  for (size_t k = 0; k < n; k++) {
    if (v[k] < 1 || v[k] > CURRENT || n != m) return refuse(c, "neither a parameter nor the current");
    if (v[k] == CURRENT ? !isfinite(x[k]) : !permitted(v[k] - J, x[k])) return refuse(c, "beyond min or max");
    if (c->running && v[k] >= FIXED && v[k] < CURRENT) return refuse(c, "contact, x1_0 and x2_0 are set before the start");
  }
  for (size_t k = 0; k < n; k++) ((double *)c)[v[k]] = x[k];
  const double current = c->b.current;
  if (c->running) brake_outputs(&c->b);
  else brake_start(&c->b);
  c->b.current = current;
  return OK;
}
FMI(fmi3DoStep)(instance *c, double point, double size, _Bool final, _Bool *event, _Bool *ends, _Bool *early,
                double *last) {
  if (!(c->running && size > 0.0 && isfinite(size))) return refuse(c, "expected a step longer than 0 s, after the start");
  *last = c->time, *event = *ends = *early = 0;
  const int failed = brake_step(&c->b, c->b.current, size);
  if (failed == 2) return refuse(c, "more than 100000 segments: the step is too long, or parameters are extreme");
  if (failed) return refuse(c, "no finite motion: parameters are extreme");
  c->time = *last = point + size;
  return OK;
}
FMI(fmi3GetFMUState)(instance *c, void **kept) {
  if (!*kept && !(*kept = malloc(sizeof *c))) return refuse(c, "no memory");
  return memcpy(*kept, c, sizeof *c), OK;
}
FMI(fmi3SetFMUState)(instance *c, void *kept) { return memcpy(c, kept, sizeof *c), OK; }
FMI(fmi3FreeFMUState)(instance *c, void **kept) { return free(*kept), *kept = NULL, OK; }

/* What this FMU has no use for. */
typedef const uint8_t *binary;
#define KEYS const reference v[], size_t n
#define REFUSED(name) { return refuse(c, "fmi3" #name ": this FMU does not have it"); }
#define NONE(name, ...) FMI(fmi3##name)(instance *c, __VA_ARGS__) REFUSED(name)
#define NO_MODE(name) FMI(fmi3##name)(instance *c) REFUSED(name)
#define NO_TYPE(name, type) NONE(Get##name, KEYS, type x[], size_t m) NONE(Set##name, KEYS, const type x[], size_t m)
#define NO_STATES(name) NONE(name, double x[], size_t n)
#define NO_DERIVATIVE(name) \
  NONE(name, KEYS, const reference k[], size_t m, const double seed[], size_t seeds, double x[], size_t xs)
NO_TYPE(Float32, float) NO_TYPE(UInt16, uint16_t) NO_TYPE(UInt32, uint32_t) NO_TYPE(UInt64, uint64_t)
NO_TYPE(UInt8, uint8_t) NO_TYPE(Int16, int16_t) NO_TYPE(Int32, int32_t) NO_TYPE(Int64, int64_t) NO_TYPE(Boolean, _Bool)
NO_TYPE(Int8, int8_t) NO_TYPE(String, text) NO_MODE(EnterContinuousTimeMode) NO_MODE(EnterConfigurationMode)
NO_MODE(EvaluateDiscreteStates) NO_MODE(ExitConfigurationMode) NO_MODE(EnterEventMode) NO_MODE(EnterStepMode)
NO_STATES(GetEventIndicators) NO_STATES(GetContinuousStateDerivatives) NO_STATES(GetNominalsOfContinuousStates)
NO_STATES(GetContinuousStates) NO_DERIVATIVE(GetDirectionalDerivative) NO_DERIVATIVE(GetAdjointDerivative)
NONE(GetVariableDependencies, reference v, size_t a[], reference b[], size_t d[], int e[], size_t n)
NONE(UpdateDiscreteStates, _Bool *d, _Bool *e, _Bool *f, _Bool *g, _Bool *h, double *time) NONE(SetTime, double time)
NONE(GetOutputDerivatives, KEYS, const int32_t o[], double x[], size_t m) NONE(SetShiftDecimal, KEYS, const double x[])
NONE(SetBinary, KEYS, const size_t sizes[], const binary x[], size_t m) NONE(SetIntervalDecimal, KEYS, const double x[])
NONE(SetIntervalFraction, KEYS, const uint64_t x[], const uint64_t y[]) NONE(GetNumberOfContinuousStates, size_t *n)
NONE(DeserializeFMUState, const uint8_t x[], size_t size, void **kept) NONE(GetNumberOfEventIndicators, size_t *n)
NONE(GetIntervalFraction, KEYS, uint64_t x[], uint64_t y[], int z[]) NONE(GetIntervalDecimal, KEYS, double x[], int y[])
NONE(SetShiftFraction, KEYS, const uint64_t x[], const uint64_t y[]) NONE(GetShiftDecimal, KEYS, double x[])
NONE(GetNumberOfVariableDependencies, reference v, size_t *n) NONE(CompletedIntegratorStep, _Bool d, _Bool *e, _Bool *f)
NONE(SerializeFMUState, void *kept, uint8_t x[], size_t size) NONE(ActivateModelPartition, reference clock, double time)
NONE(GetBinary, KEYS, size_t sizes[], binary x[], size_t m) NONE(GetShiftFraction, KEYS, uint64_t x[], uint64_t y[])
NONE(SerializedFMUStateSize, void *kept, size_t *size) NONE(SetContinuousStates, const double x[], size_t n)
NONE(SetClock, KEYS, const _Bool x[]) NONE(GetClock, KEYS, _Bool x[])
