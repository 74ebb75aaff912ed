#ifndef BRAKE_H
#define BRAKE_H
#ifdef __cplusplus
extern "C" {
#endif
typedef struct {
@fields@ /* parameters: brake_init says what they are */
  double current;                   /* input of the last step [A] */
  double angle, velocity;           /* outputs: of the motor [rad], [rad/s] */
  double clamping_force;            /* output [N] */
  double friction_torque;           /* output, positive against a positive velocity [N.m] */
  double x1, x2, w, i;              /* state: angle from contact, velocity, stop of the clamp, current in the motor */
} brake;

void brake_init(brake *b);  /* parameters as identified; then brake_start */
void brake_start(brake *b); /* to x1_0 and x2_0, without current */
/* A current [A] held for a time [s]: 0 when it has passed; else nothing has changed: 1 for a value that is not finite,
 * or a parameter beyond min or max; 2 for a step that takes too many segments: too long, or extreme parameters. */
int brake_step(brake *b, double current, double dt);
void brake_outputs(brake *b); /* outputs of the state, after a parameter has changed */
#ifdef __cplusplus
}
#endif
#endif

#ifndef BRAKE_DECLARATIONS_ONLY
#include <math.h>
/* Segments of a step. One of 1 s takes at most 49,000, by 6,000 brakes with each parameter at an end of its search
 * range; by the rate of the exact series 20,000. More would take longer than 0.1 s. */
enum { MOST = 100000 };
