#ifndef BRAKE_H
#define BRAKE_H
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
void brake_step(brake *b, double current, double dt); /* a current [A] that is held for a time [s] */
void brake_outputs(brake *b); /* outputs of the state, after a parameter has changed */
#endif

#ifndef BRAKE_DECLARATIONS_ONLY
#include <math.h>
