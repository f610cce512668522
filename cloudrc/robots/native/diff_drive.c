/*
 * SPDX-License-Identifier: Apache-2.0
 */

/* Wheels on the left and on the right: the twin of onboard/diff_drive.py, DiffDrive.update. */

#include "step.h"

typedef struct { /* onboard/_twins.py has the same fields in the same order */
  double slow, near_rest, keep_end, turn_gain, turn_rate_max, speed_max, half_track;
  i64 count;
  double wheels[ACTUATORS_MAX][2]; /* place to the left of the base, and command per speed */
  double lead;                     /* memory, which Python reads and writes between two runs */
} DiffDrive;

static const double ROUNDING = 1e-9; /* [1]: larger than any relative rounding error */

/* Return the speed, with its last bit right where this bit matters: only near rest, and where the
   front is about to become the rear. There it takes a call of Python. */
static double speed_of(const StepState *f, const DiffDrive *c, double ahead, double left) {
  double speed = sqrt(ahead * ahead + left * left), room = ROUNDING * speed;
  double above_end = c->lead * ahead + c->keep_end * speed;
  if (speed - room > c->slow && (above_end > room || above_end < -room)) return speed;
  return f->hypot(ahead, left);
}

/* Stop the wheels of a robot that is switched off. */
static void stop(StepState *f, const DiffDrive *c) {
  for (i64 i = 0; i < c->count; i++) f->ctrl[i] = f->speeds[i] = f->stopped[i];
  for (int i = 0; i < 6; i++) f->applied[i] = 0.0;
}

int cloudrc_diff_drive(StepState *f, const Readings *r) {
  DiffDrive *c = f->controller;
  if (f->is_off) {
    stop(f, c);
    return 1;
  }
  double x = f->reference[0], y = f->reference[1];
  double ahead_x = r->axes[0], ahead_y = r->axes[1];
  double ahead = x * ahead_x + y * ahead_y, left = y * ahead_x - x * ahead_y;
  double speed = speed_of(f, c, ahead, left);
  if (c->lead * ahead < -c->keep_end * speed) c->lead = -c->lead;
  double share = speed / c->slow;
  if (1.0 < share) share = 1.0;
  if (f->yaw_rate != 0.0 && speed < c->near_rest) share = 0.0;
  double angle = f->atan2(c->lead * left, c->lead * ahead);
  double turn = share * c->turn_gain * angle + (1.0 - share) * f->yaw_rate;

  double most = c->turn_rate_max;
  turn = turn > most ? most : turn < -most ? -most : turn;
  double rest = c->speed_max - (turn < 0.0 ? -turn : turn) * c->half_track;
  if (rest < ahead) ahead = rest;
  if (-rest > ahead) ahead = -rest;
  for (i64 i = 0; i < c->count; i++)
    f->ctrl[i] = f->speeds[i] = (ahead - turn * c->wheels[i][0]) * c->wheels[i][1];
  for (int i = 0; i < 6; i++) f->applied[i] = 0.0;
  return 1;
}
