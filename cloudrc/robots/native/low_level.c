/*
 * SPDX-License-Identifier: Apache-2.0
 */

/* The Pelican's controller and rotors: the twin of pelican/low_level.py and pelican/rotors.py.

     update        low_level.LowLevel.update
     turn_rotors   rotors.Rotors.step, simulator.Simulator.step */

#include "step.h"

typedef struct { /* pelican/twin.py has the same fields in the same order */
  /* Constants of the Python modules rotors and low_level, with the same names. */
  double thrust_coefficient, torque_ratio, drag_coefficient, arm, height;
  double mass, gravity, tilt_gain, yaw_gain, tilt_rate_gain, yaw_rate_gain;
  double thrust_max, tiny, nose_cosine_min, yaw_sine_max;
  double up, down, gains[9], limit_xy, limit_z, dt;
  /* Memory, which Python reads and writes between two runs. */
  double integral[3], error[3];
  i64 has_error;
} LowLevel;

static double speed_of(const LowLevel *c, double thrust) {
  double t = thrust < 0.0 ? 0.0 : thrust;
  return sqrt((t > c->thrust_max ? c->thrust_max : t) / c->thrust_coefficient);
}

static void update(LowLevel *c, const double *reference, const Readings *r, double *commands) {
  const double *g = c->gains, *a = r->axes, *rate = r->twist + 3;
  double force[3];
  for (int i = 0; i < 3; i++) {
    double e = reference[i] - r->twist[i], last = c->has_error ? c->error[i] : e;
    double limit = i == 2 ? c->limit_z : c->limit_xy, s = c->integral[i] + e * c->dt;
    s = s > limit ? limit : s < -limit ? -limit : s;
    c->error[i] = e, c->integral[i] = s;
    force[i] = g[i] * e + g[3 + i] * s + g[6 + i] * (e - last);
  }
  c->has_error = 1;
  double fx = force[0], fy = force[1], fz = force[2] + c->mass * c->gravity;

  double thrust = fx * a[6] + fy * a[7] + fz * a[8];
  double across = fy * fy + fz * fz, size = sqrt(fx * fx + across), scale;
  scale = 1.0 / (size != 0.0 ? size : c->tiny);
  double z0 = scale * (fx * a[0] + fy * a[1] + fz * a[2]);
  double z1 = scale * (fx * a[3] + fy * a[4] + fz * a[5]);
  double z2 = scale * thrust;
  size = sqrt(across);
  scale = 1.0 / (size != 0.0 ? size : c->tiny);
  double y0 = scale * (fz * a[1] - fy * a[2]);
  double y1 = scale * (fz * a[4] - fy * a[5]);
  double y2 = scale * (fz * a[7] - fy * a[8]);
  double roll = y2 - z1, pitch = z0 + y1 * z0 - y0 * z1, yaw;
  if (y1 < c->nose_cosine_min || a[1] > c->yaw_sine_max || a[1] < -c->yaw_sine_max)
    roll = -z1 - z1, pitch = z0 + z0;
  roll = 0.5 * c->tilt_gain * roll - c->tilt_rate_gain * rate[0];
  pitch = 0.5 * c->tilt_gain * pitch - c->tilt_rate_gain * rate[1];
  yaw = 0.5 * c->yaw_gain * (y2 * z0 - y0 * z2 - y0) - c->yaw_rate_gain * rate[2];

  roll = roll / (2.0 * c->arm), pitch = pitch / (2.0 * c->arm);
  yaw = yaw / (4.0 * c->torque_ratio);
  double share = 0.25 * thrust, with_yaw = share + yaw, against_yaw = share - yaw;
  double thrusts[4] = {with_yaw - pitch, against_yaw + roll, with_yaw + pitch, against_yaw - roll};
  int plain = thrust <= c->thrust_max;
  for (int i = 0; i < 4; i++) plain = plain && thrusts[i] >= 0.0;
  for (int i = 0; i < 4; i++)
    commands[i] = plain ? sqrt(thrusts[i] / c->thrust_coefficient) : speed_of(c, thrusts[i]);
}

static void turn_rotors(StepState *f, const LowLevel *c, const Readings *r,
                        const double *commands) {
  const double *a = r->axes, *v = r->twist, *rate = r->twist + 3;
  double *s = f->speeds;
  for (int i = 0; i < 4; i++) s[i] += (commands[i] - s[i]) * (commands[i] > s[i] ? c->up : c->down);

  double total = c->drag_coefficient * (s[0] + s[1] + s[2] + s[3]);
  double drag_arm = c->drag_coefficient * c->arm;
  double across_x = drag_arm * (s[0] - s[2]), across_y = drag_arm * (s[1] - s[3]);
  double u = a[0] * v[0] + a[1] * v[1] + a[2] * v[2] + rate[1] * c->height;
  double w = a[3] * v[0] + a[4] * v[1] + a[5] * v[2] - rate[0] * c->height;
  double force_x = across_y * rate[2] - total * u;
  double force_y = -across_x * rate[2] - total * w;
  for (int i = 0; i < 4; i++) f->ctrl[i] = c->thrust_coefficient * s[i] * s[i];
  for (int i = 0; i < 3; i++) f->applied[i] = a[i] * force_x + a[3 + i] * force_y;
  f->applied[3] = -c->height * force_y;
  f->applied[4] = c->height * force_x;
  f->applied[5] = across_y * u - across_x * w - c->arm * c->arm * total * rate[2];
}

int cloudrc_low_level(StepState *f, const Readings *r) {
  LowLevel *c = f->controller;
  double commands[4];
  if (!f->is_off) update(c, f->reference, r, commands);
  turn_rotors(f, c, r, f->is_off ? f->stopped : commands);
  return 1;
}
