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
/* A current [A] held for a time [s]: 0 when it has passed; else (not finite, J <= 0, too extreme) nothing has changed. */
int brake_step(brake *b, double current, double dt);
void brake_outputs(brake *b); /* outputs of the state, after a parameter has changed */
#endif

#ifndef BRAKE_DECLARATIONS_ONLY
#include <math.h>
static const int MOST = 100000; /* segments of a step */
