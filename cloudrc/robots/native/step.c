/*
 * SPDX-License-Identifier: Apache-2.0
 */

/* Fly the robot in the usual case: a fresh command that the guard need not limit.

   This file is the twin of Python code, and gives the same bits. The Python code is the reference:
   it has the sources of all formulas and numbers, and it flies the robot in every other case.

     read          readings.Readings.of
     guard_step    guard.state.Guard.step, for a robot in TRACK with a fresh command
     is_far        guard.limits.limit_to_fence, where it changes nothing
     control       the robot's own: low_level.c, multirotor.c, diff_drive.c
     feel          simulator.Simulator._feel

   Where nothing can touch the robot, `step_physics` lets MuJoCo look for no contacts. */

#include "step.h"

static const double ROOM = 1e-6; /* [m]: no rounding error matters, the fence limits nothing */

static void read(const StepState *f, Readings *r) {
  for (int i = 0; i < 7; i++) r->pose[i] = f->qpos[i];
  for (int i = 0; i < 6; i++) r->twist[i] = f->qvel[i];
  double w = r->pose[3], x = r->pose[4], y = r->pose[5], z = r->pose[6];
  double x2 = x + x, y2 = y + y, z2 = z + z;
  double wx = w * x2, wy = w * y2, wz = w * z2;
  double xx = x * x2, xy = x * y2, xz = x * z2;
  double yy = y * y2, yz = y * z2, zz = z * z2;
  double *a = r->axes;
  a[0] = 1.0 - yy - zz, a[1] = xy + wz, a[2] = xz - wy;
  a[3] = xy - wz, a[4] = 1.0 - xx - zz, a[5] = yz + wx;
  a[6] = xz + wy, a[7] = yz - wx, a[8] = 1.0 - xx - yy;
}

/* Tell whether the fence does not limit the velocity at the position. */
static int is_far(const StepState *f, const double *velocity, const double *position) {
  for (int i = 0; i < 3; i++) {
    double low = f->low[i], high = f->high[i], v = velocity[i];
    double reaction = i == 2 ? f->reaction : f->fence_reaction; /* towards the lower face */
    if (v > 0.0)
      high -= v * (f->fence_reaction + v * f->stop_coefficient);
    else
      low -= v * (reaction - v * f->stop_coefficient);
    if (!(low + ROOM <= position[i] && position[i] <= high - ROOM)) return 0;
  }
  return 1;
}

/* Move the reference by one step; return 0, with nothing changed, if Python has to do this step. */
static int guard_step(StepState *f, const Readings *r, i64 now_ns) {
  if (r->axes[8] < f->overturned_cosine || now_ns > f->track_until_ns) return 0;
  const double *from = f->reference, *to = f->wanted;
  double x = to[0] - from[0], y = to[1] - from[1], z = to[2] - from[2];
  double square = x * x + y * y + z * z;
  int settles = square <= f->change_max * f->change_max;
  double share = settles ? 0.0 : f->change_max / sqrt(square);
  double moved[3] = {from[0] + share * x, from[1] + share * y, from[2] + share * z};
  const double *reference = settles ? to : moved;
  if (reference[2] < r->twist[2] - f->sink_lead_max) return 0;
  if (!is_far(f, reference, r->pose)) return 0;
  for (int i = 0; i < 3; i++) f->reference[i] = reference[i];
  return 1;
}

/* Measure the probe's force, and note in is_news whether Python has to look at the contacts. */
static void feel(StepState *f) {
  i64 contacts = *f->contacts, before = f->touching;
  f->is_news = 0;
  if (!contacts && !before) return;
  double force = *f->probe_force;
  f->impulse += force * f->time_step;
  if (force > f->force_peak) f->force_peak = force;
  f->is_news = contacts && (contacts != before || f->steps % f->check_steps == 0);
  f->touching = contacts;
}

/* Return for how many steps nothing can touch a ball around the robot. The speed grows by at most
   acceleration_max. */
static i64 free_steps(const StepState *f, const double *position, const double *velocity) {
  double nearest = 1e6, speed = 0.0, most = f->acceleration_max;
  for (const Obstacle *o = f->obstacles; o < f->obstacles + f->obstacle_count; o++) {
    double square = 0.0;
    for (int axis = 0; axis < 3; axis++) {
      double along = 0.0;
      for (int i = 0; i < 3; i++) along += o->axes[3 * i + axis] * (position[i] - o->centre[i]);
      double beyond = (along < 0.0 ? -along : along) - o->half[axis];
      if (beyond > 0.0) square += beyond * beyond;
    }
    double distance = sqrt(square) - o->radius;
    if (distance < nearest) nearest = distance;
  }
  nearest -= f->robot_radius;
  if (!(nearest > 0.0)) return 0;
  for (int i = 0; i < 3; i++) speed += velocity[i] * velocity[i];
  speed = sqrt(speed);
  double duration = (sqrt(speed * speed + 2.0 * most * nearest) - speed) / most;
  i64 steps = (i64)(duration / f->time_step) - 1;
  return steps > 100 ? 100 : steps;
}

/* Do a step of MuJoCo. While nothing can touch the robot, MuJoCo need not look for contacts. This
   changes no bit of the result, and takes half the time. */
static void step_physics(StepState *f, const Readings *r) {
  if (f->free_steps == 0 && !f->touching) {
    f->free_steps = free_steps(f, r->pose, r->twist);
    if (f->free_steps <= 0) f->free_steps = -5;
  }
  f->mj_step(f->free_steps > 0 ? f->free_model : f->model, f->data);
  f->free_steps += f->free_steps < 0 ? 1 : f->free_steps > 0 ? -1 : 0;
}

/* Run steps from now_ns up to until_ns [ns]; return their number, and move now_ns on. The run ends
   early before a step that Python has to do, and after a step with new contacts. */
i64 cloudrc_run(StepState *f) {
  i64 steps = 0;
  double (*timer)(void) = *f->timer;
  *f->timer = 0;
  f->is_news = 0;
  for (; f->now_ns < f->until_ns && !f->is_news; f->now_ns += f->step_ns) {
    Readings r;
    read(f, &r);
    double x = f->reference[0], y = f->reference[1], z = f->reference[2];
    if (!guard_step(f, &r, f->now_ns)) break;
    if (!f->control(f, &r)) {
      f->reference[0] = x, f->reference[1] = y, f->reference[2] = z;
      break;
    }
    for (int i = 0; i < 7; i++) f->before[i] = r.pose[i];
    for (int i = 0; i < 6; i++) f->before[7 + i] = r.twist[i];
    step_physics(f, &r);
    f->steps++, steps++;
    feel(f);
  }
  *f->timer = timer;
  return steps;
}
