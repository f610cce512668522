/*
 * SPDX-License-Identifier: Apache-2.0
 */

/* Fly the robot in the usual cases: a fresh command that the guard need not limit, and a robot that
   stands on the ground, switched off.

   This file is the twin of Python code, and gives the same bits. The Python code is the reference:
   it has the sources of all formulas and numbers, and it flies the robot in every other case.

     read          readings.Readings.of
     guard_step    guard.state.Guard.step, for a robot in TRACK with a fresh command
     has_left      guard.hold.TakeOff.look, for a robot that is switched on
     is_inside     guard.limits.limit_to_fence, where it changes nothing
     control       the robot's own: low_level.c, multirotor.c, diff_drive.c
     feel          simulator.Simulator._feel
     go_on         simulator.Simulator._note_contacts, for contacts that are not new

   Where nothing can touch the robot, `step_physics` lets MuJoCo look for no contacts. */

#include "step.h"

static const double FASTEST = 1e300; /* [m/s]: no velocity is larger */
static const double UNSURE = 1e-9; /* [m^2]: larger than a rounding error of a squared distance */
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

/* Return the largest velocity towards a face of the fence. */
static double approach_speed(const StepState *f, double distance, double reaction) {
  if (distance > f->far) return FASTEST;
  if (distance > 0.0) {
    double root = sqrt(reaction * reaction + 4.0 * f->stop_coefficient * distance);
    return 2.0 * distance / (reaction + root);
  }
  double back = f->return_gain * distance, most = -f->return_speed_max;
  return distance < 0.0 ? (most > back ? most : back) : 0.0;
}

/* Tell whether the fence does not limit the velocity, also where a face is near. */
static int is_inside(const StepState *f, const double *velocity, const double *position) {
  if (is_far(f, velocity, position)) return 1;
  double x = velocity[0], y = velocity[1], most = f->low_speed;
  if (!(position[2] >= f->low_height)) {
    if (x > most || -x > most || y > most || -y > most) return 0;
    if (x * x + y * y > most * most) return 0;
  }
  for (int i = 0; i < 3; i++) {
    double reaction = i == 2 ? f->reaction : f->fence_reaction; /* towards the lower face */
    double least = -approach_speed(f, position[i] - f->low[i], reaction);
    double largest = approach_speed(f, f->high[i] - position[i], f->fence_reaction);
    if (i == 2 && least > 0.0) least = 0.0;
    if (!(least <= velocity[i] && velocity[i] <= largest)) return 0;
  }
  return 1;
}

/* Tell whether the robot has left the ground. */
static int has_left(const StepState *f, const Readings *r) {
  double rise = r->pose[2] - f->ground;
  return f->is_over || !((rise < 0.0 ? -rise : rise) < f->lift_off);
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
  if (!is_inside(f, reference, r->pose)) return 0;
  f->is_over = has_left(f, r);
  for (int i = 0; i < 3; i++) f->reference[i] = reference[i];
  return 1;
}

/* Tell which part touches at a place: 1 the probe, 0 another part, -1 it may be both. */
static int touching_part(const StepState *f, const double *place) {
  if (!f->probe) return 1;
  double square = 0.0;
  for (int i = 0; i < 3; i++)
    square += (place[i] - f->probe[i]) * (place[i] - f->probe[i]);
  double beyond = square - f->probe_radius * f->probe_radius;
  return beyond < -UNSURE ? 1 : beyond > UNSURE ? 0 : -1;
}

/* Return where the step of the last contact like this one is noted; 0 if only Python knows. */
static i64 *last_touch(const StepState *f, i64 shift) {
  const int *geoms = (const int *)(f->contact_geoms + shift);
  if (geoms[0] < 0 || geoms[1] < 0) return 0;
  i64 body = f->bodies[geoms[0]] ? f->bodies[geoms[0]] : f->bodies[geoms[1]];
  int part = touching_part(f, (const double *)(f->contact_place + shift));
  return part < 0 ? 0 : f->touched + 2 * body + part;
}

/* Note all contacts if none of them is new; otherwise return 0, with nothing changed. */
static int go_on(const StepState *f) {
  i64 end = *f->contacts * f->contact_size;
  if (!f->contact_geoms) return 0;
  for (int notes = 0; notes <= 1; notes++)
    for (i64 shift = 0; shift < end; shift += f->contact_size) {
      if (*(const int *)(f->contact_excluded + shift)) continue;
      i64 *last = last_touch(f, shift);
      if (!last || f->steps - *last > f->gap_steps) return 0;
      if (notes) *last = f->steps;
    }
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
  f->is_news = contacts && (contacts != before || f->steps % f->check_steps == 0) && !go_on(f);
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
    i64 was_over = f->is_over;
    if (!f->is_off && !guard_step(f, &r, f->now_ns)) break;
    if (!f->control(f, &r)) {
      f->reference[0] = x, f->reference[1] = y, f->reference[2] = z, f->is_over = was_over;
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
