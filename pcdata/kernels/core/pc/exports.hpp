// The interface of the compiled core: every function that Python calls, and nothing else.
//
// Types of arguments are read from here (write_signatures.py), and a hash of the declarations is the number of the
// interface: Python refuses a library that was built from others. All but the first two functions return a status.
//
// Arrays are contiguous, shapes are given row by row. Points, rays and directions are float32 (N, 3); ptr are the row
// pointers of ragged clouds; sources, picked and other addresses are int64. What may be null says so.
#pragma once

#include <cstdint>

#define PC_EXPORT extern "C" __attribute__((visibility("default")))

// What Python passes to every call.
struct pc_context {
  int32_t threads;    // how many may work, the caller included
  int32_t (*poll)();  // asked now and then by the calling thread; non-zero = stop (Ctrl-C); may be null
};

// -- the library itself -----------------------------------------------------------------------------------------------

// A hash of the declarations in this file.
PC_EXPORT int64_t pc_interface_number();

// Only meaningful in the baseline library, which runs everywhere: 0 baseline, 1 avx2, 2 avx512.
PC_EXPORT int32_t pc_best_instruction_set();

// Ask for huge pages in blocks that are about to be filled: a page fault costs more than filling its 4 KB, and a huge
// page takes one for 2 MB. Advice only, content stays. The huge pages at both ends count as well, or blocks of a few
// megabytes, one behind the other in the heap, would get half of theirs: what else lies there is already in memory, and
// stays as it is, or is free.
PC_EXPORT int32_t pc_advise_huge_pages(const pc_context* context, int64_t count, const int64_t* addresses,
                                       const int64_t* bytes);

// -- depth images -----------------------------------------------------------------------------------------------------

// Which pixels of depth (views, height, width) become points: keep (views, height, width) becomes 1 there. A pixel does
// if its depth is positive, within [near, far], inside the mask, and its point, moved by the matrix of its view, inside
// the box lower, upper (3,); the last three may be null. Also counted: readings
// (views,) are the pixels that the box decided about, and starts (views * height + 1,) where the points of each image
// row start. *possible becomes 0, and nothing else is certain, if a depth is negative or not a number, or if a reading
// has no ray or no finite point.
//
// Rays of pinhole cameras without distortion: x/z of every column (views, width), y/z of every image row (views,
// height). Or those of any cameras: x/z and y/z of every pixel (views, height, width, 2). The others are null.
PC_EXPORT int32_t pc_choose_pixels(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                   int64_t width, const float* column_rays, const float* row_rays, const float* rays,
                                   double near, double far, const uint8_t* mask, const double* matrices,
                                   const float* lower, const float* upper, uint8_t* keep, int64_t* readings,
                                   int64_t* starts, int64_t* possible);

// The pixels that pc_choose_pixels kept -> points (M, 3) moved by the matrices, pixel_index (M,), and the rows of the
// companions. Takes its rays and matrices.
PC_EXPORT int32_t pc_deproject(const pc_context* context, const float* depth, int64_t views, int64_t height,
                               int64_t width, const float* column_rays, const float* row_rays, const float* rays,
                               const double* matrices, const uint8_t* keep, const int64_t* starts, float* points,
                               int64_t* pixel_index, int64_t over_all_views, const uint8_t* rgb, float* colors,
                               int64_t num_copied, const int64_t* sources, const int64_t* pixel_bytes,
                               const int64_t* copies);

// masked (count,) = depth where it is positive, within [near, far] and inside the mask, which may be null; 0 elsewhere.
PC_EXPORT int32_t pc_mask_depth(const pc_context* context, const float* depth, int64_t count, double near, double far,
                                const uint8_t* mask, float* masked);

// What is asked of every image of a stream: extremes (2,) the least and the largest of depth (count,), both NaN where
// one is NaN or infinite; *same whether all are as before, which may be null: then they are not. Written to copy, which
// may be null. Zeros of both signs are the same, NaN never is.
PC_EXPORT int32_t pc_look_at_depth(const pc_context* context, const float* depth, int64_t count, const float* before,
                                   float* copy, float* extremes, int64_t* same);

// Depth images (views, height, width) -> registered and pixel_index (views, color_height, color_width), occluding of
// that shape and hidden (views, height, width), as register_depth describes them. Rays are those of pc_choose_pixels.
// Per view: color_from_depth (4, 4), color_intrinsics (3, 3), half_pixels (2,), and lenses (14,), which may be null.
// *possible becomes 0, and nothing else is certain, if a reading has no ray or projects beyond what floats can be
// computed with.
PC_EXPORT int32_t pc_register_depth(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                    int64_t width, const float* column_rays, const float* row_rays, const float* rays,
                                    const double* color_from_depth, const double* color_intrinsics,
                                    const double* half_pixels, const double* lenses, int64_t color_height,
                                    int64_t color_width, double max_jump, float* registered, int64_t* pixel_index,
                                    uint8_t* occluding, uint8_t* hidden, int64_t* possible);

// -- rows of fields, and points under maps ----------------------------------------------------------------------------

// Which rows a decision leaves: keep (N,) becomes 1 where marks (N,) are true, or, with `gone`, are not, and `within`
// (N,) is true, which may be null. Also the row pointers of what is kept, kept_ptr (clouds + 1,), and sums (clouds,),
// which tell what is kept of the rows within.
PC_EXPORT int32_t pc_kept_rows(const pc_context* context, const uint8_t* marks, int64_t gone, const uint8_t* within,
                               const int64_t* ptr, int64_t num_clouds, uint8_t* keep, int64_t* kept_ptr, int64_t* sums);

// Copy the rows where the mask is true, if there is room for so many; *kept becomes their number. Rows may be picked
// within their own memory.
PC_EXPORT int32_t pc_keep_rows(const pc_context* context, const uint8_t* mask, int64_t rows, int64_t room,
                               int64_t num_fields, const int64_t* sources, const int64_t* row_bytes,
                               const int64_t* picked, int64_t* kept);

// Copy the rows of clouds where the mask kept (N,) is true, from where each cloud has those of a field: sources
// (fields, clouds), addresses. Those of a cloud go to row kept_ptr[cloud] of each field's picked.
PC_EXPORT int32_t pc_gather_kept(const pc_context* context, const int64_t* ptr, int64_t num_clouds, const uint8_t* kept,
                                 const int64_t* kept_ptr, int64_t num_fields, const int64_t* sources,
                                 const int64_t* row_bytes, const int64_t* picked);

// Copy the rows index (num_picked,) of `rows`; *possible becomes 0, and nothing is certain, if one lies outside.
PC_EXPORT int32_t pc_take_rows(const pc_context* context, const int64_t* index, int64_t num_picked, int64_t rows,
                               int64_t num_fields, const int64_t* sources, const int64_t* row_bytes,
                               const int64_t* picked, int64_t* possible);

// Put parts of fields into one block per field. Part p has counts[p] rows and goes to rows starts[p] to starts[p + 1]
// of the block; what it leaves empty is filled with the field's filler byte. sources (fields, parts) are addresses.
PC_EXPORT int32_t pc_place_rows(const pc_context* context, int64_t num_parts, const int64_t* counts,
                                const int64_t* starts, int64_t num_fields, const int64_t* sources,
                                const int64_t* row_bytes, const int64_t* fillers, const int64_t* blocks);

// Find records (num_records,) by their places. Group g has the records from place firsts[g] on, and which (groups, 2):
// its form, and its number among those of the form. tables (groups of the form, columns, 3) say of a column of a group
// its address, how many rows every record has, and where among `pointers` those to the rows of each begin, -1 = as many
// in all. roles (columns,): 0 any rows, 1 a row for each point, 2 one for each cloud, 3 row pointers, 4 a text.
// table, int64: what was found, 0 = a record of another form, and nothing else is written, 1 = rows, 2 = one cloud
// each; the column of row pointers, or -1; starts (columns + 1,): the bytes where each column begins once its records
// are copied, multiples of 64; ends (columns, records): the rows up to and with each; and of the rows of each their
// sources (columns, records), addresses, and sizes (columns, records), bytes.
PC_EXPORT int32_t pc_find_records(const pc_context* context, const int64_t* places, int64_t num_records,
                                  const int64_t* firsts, const int64_t* which, int64_t num_groups, int64_t form,
                                  const int64_t* tables, const int64_t* pointers, int64_t num_columns,
                                  const int64_t* row_bytes, const int64_t* roles, int64_t* table);

// Copy what was found to starts[columns] bytes. Of one cloud each, the row pointers are those of all.
PC_EXPORT int32_t pc_gather_records(const pc_context* context, int64_t num_records, int64_t num_columns,
                                    const int64_t* row_bytes, const int64_t* roles, const int64_t* table,
                                    uint8_t* into);

// moved (N, 3) = matrix (clouds, 4, 4) of each point's cloud @ point, in float64, rounded once.
PC_EXPORT int32_t pc_transform_points(const pc_context* context, const float* points, const int64_t* ptr,
                                      int64_t num_clouds, const double* matrices, float* moved);

// turned (N, 3) = linear (clouds, 3, 3) of each row's cloud @ direction in float64, divided by its length (by 1e-12 if
// that is larger), rounded once.
PC_EXPORT int32_t pc_transform_directions(const pc_context* context, const float* directions, const int64_t* ptr,
                                          int64_t num_clouds, const double* linear, float* turned);

// moved (M, 3) = the points (N, 3) after num_steps steps, rounded to float after each; points and moved may be the
// same. Where sources (clouds,) is not null, the points of each cloud lie at its address instead. Step s is a motion by
// matrices (steps, clouds, 4, 4) in float64, or, where is_noise (steps,) is not 0, the sum with normal numbers of the
// seeds (steps, clouds), times sigma (steps,), at most clip (steps,) in size. Of the points only those where the mask
// kept (N,) is true are written, one after another, those of each cloud to kept_ptr (clouds + 1,); both may be null:
// then all are.
PC_EXPORT int32_t pc_move_points(const pc_context* context, const float* points, const int64_t* sources,
                                 const int64_t* ptr, int64_t num_clouds, int64_t num_steps, const int64_t* is_noise,
                                 const double* matrices, const int64_t* seeds, const double* sigma, const double* clip,
                                 const uint8_t* kept, const int64_t* kept_ptr, float* moved);

// matrices (steps, clouds, 4, 4) as draw_motions draws them of the streams of keys (clouds,): draws (num_draws, 8).
PC_EXPORT int32_t pc_draw_motions(const pc_context* context, const int64_t* keys, int64_t num_clouds,
                                  const double* draws, int64_t num_draws, int64_t num_steps, double* matrices);

// result (clouds, 4, 4) = source_from_cloud (clouds, 4, 4) @ the inverse of one of matrices (steps, clouds, 4, 4) after
// another. *possible becomes 0, and nothing else is certain, if one is nearly flat.
PC_EXPORT int32_t pc_led_back(const pc_context* context, const double* matrices, int64_t num_steps, int64_t num_clouds,
                              const double* source_from_cloud, double* result, int64_t* possible);

// *plain = 1 if all matrices (count, 4, 4) are finite and affine, and far from being flat; else 0.
PC_EXPORT int32_t pc_are_plain_motions(const pc_context* context, const double* matrices, int64_t count,
                                       int64_t* plain);

// rows (sum of wanted,): the first wanted (clouds,) rows of a permutation of each cloud's counts (clouds,) rows, at
// most 2^32 - 1, sorted by the upper halves of the words of its seed and then by themselves; rows are those of all
// clouds.
PC_EXPORT int32_t pc_random_order(const pc_context* context, int64_t num_clouds, const int64_t* counts,
                                  const int64_t* wanted, const int64_t* seeds, int64_t* rows);

// mask (N,) and kept_ptr (clouds + 1,) of what stays of clouds without a part of each within [low, high), by the first
// two words of the streams of keys (clouds,).
PC_EXPORT int32_t pc_dropped_rows(const pc_context* context, const int64_t* keys, const int64_t* ptr,
                                  int64_t num_clouds, double low, double high, uint8_t* mask, int64_t* kept_ptr);

// inside (N,) becomes 1 where lower <= point <= upper on every axis; *finite 0 if a coordinate is not.
PC_EXPORT int32_t pc_inside_box(const pc_context* context, const float* points, int64_t rows, const float* lower,
                                const float* upper, uint8_t* inside, int64_t* finite);

// inside (N,) becomes 1 where lower <= point <= upper on every axis, the corners (num_clouds, 3) of its cloud's box.
PC_EXPORT int32_t pc_box_mask(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                              const float* lower, const float* upper, uint8_t* inside);

// inside (rows,) becomes 1 where a ray from the point (rows, 2) toward larger x crosses an odd number of the edges
// between the corners (num_corners, 2), the last and the first among them.
PC_EXPORT int32_t pc_polygon_mask(const pc_context* context, const float* points, int64_t rows, const double* corners,
                                  int64_t num_corners, uint8_t* inside);

// repeats (N,) becomes 1 where an earlier point of the cloud has the same coordinates, 0 elsewhere.
PC_EXPORT int32_t pc_duplicate_mask(const pc_context* context, const float* points, const int64_t* ptr,
                                    int64_t num_clouds, uint8_t* repeats);

// points (count, 2) -> corners (*num_corners,) of room for all: the rows of their convex hull, counterclockwise, as
// hull_rows describes them.
PC_EXPORT int32_t pc_convex_hull(const pc_context* context, const double* points, int64_t count, int64_t* corners,
                                 int64_t* num_corners);

// points (count, 3); of each gripper its axes (num_grasps, 3, 3) in rows, its origin (num_grasps, 3) and the corners
// lower and upper (4, num_grasps, 3) of palm, two fingers and the room between them -> hits and held (num_grasps,), the
// points in the first three and in the last, as points_in_grippers describes them.
PC_EXPORT int32_t pc_points_in_grippers(const pc_context* context, const float* points, int64_t count,
                                        const double* axes, const double* origin, const double* lower,
                                        const double* upper, int64_t num_grasps, int64_t* hits, int64_t* held);

// -- filters of depth images ------------------------------------------------------------------------------------------

// values (views, pixels) -> scales (views,) divided by them; 0 stays 0.
PC_EXPORT int32_t pc_reciprocals(const pc_context* context, const float* values, const float* scales, int64_t views,
                                 int64_t pixels, float* reciprocals);

// values (views, height, width), 0 = no reading -> smoothed of that shape: averages along rows, then columns, forth and
// back, `iterations` times. A pixel adds `keep` of the difference from the average that arrives at it, but starts anew
// where the neighbor has no reading or lies `delta` or more away. With scales (views,), else null, their reciprocals
// are smoothed, and turned back.
PC_EXPORT int32_t pc_spatial_filter(const pc_context* context, const float* values, const float* scales, int64_t views,
                                    int64_t height, int64_t width, double keep, double delta, int64_t iterations,
                                    float* smoothed);

// values (views, pixels) and what is remembered: last (views, pixels) and history (views, pixels) -> filtered, and what
// is remembered for the next frame. scales, keep and delta as above; pixels without a reading repeat the last one where
// `needed` of the lowest `frames` bits of the history are set.
PC_EXPORT int32_t pc_temporal_filter(const pc_context* context, const float* values, const float* scales, int64_t views,
                                     int64_t pixels, double keep, double delta, int64_t needed, int64_t frames,
                                     const float* last, const uint8_t* history, float* filtered, float* new_last,
                                     uint8_t* new_history);

// depth (views, height, width) -> smoothed of that shape: means of the readings of the windows of 2 reach + 1 pixels
// that differ by at most max_jump times the nearer of the two, weighted by shares (window, window) and by 2 to the
// power of rate times the squared difference.
PC_EXPORT int32_t pc_bilateral_filter(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                      int64_t width, int64_t reach, const float* shares, double scale, double max_jump,
                                      float* smoothed);

// The same with the lower medians of those readings; of all of the window if max_jump is negative. reach is 1 to 3.
PC_EXPORT int32_t pc_median_filter(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                   int64_t width, int64_t reach, double max_jump, float* found);

// depth (views, height, width), fewer than 2^31 pixels -> filled of that shape: holes get the depth of a reading beside
// them: by rule 0 the next one to the left; by 1 and 2 layer after layer from the rims the farthest and the nearest of
// their four neighbors. With max_size, else 0, not where a square of max_size + 1 pixels that holds no reading fits
// over them. Of that shape, and null if not wanted: distance, pixels to the reading, 0 = not filled; far, 0 or 1,
// whether it is above the limit.
PC_EXPORT int32_t pc_fill_holes(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                int64_t width, int64_t rule, int64_t max_size, float* filled, int64_t* distance,
                                int64_t limit, uint8_t* far);

// values (rows, width), 0 = no reading -> filled of that shape: up to `radius` pixels of every gap take the value to
// their left, then as many of what is left of it the one to their right.
PC_EXPORT int32_t pc_fill_rows(const pc_context* context, const float* values, int64_t rows, int64_t width,
                               int64_t radius, float* filled);

// Depths before and after holes were filled (count,), and the confidence before, or null -> that after, and whether any
// pixel was filled: filled ones become 2, or 1 where far (count,) is set, which may be null; without confidence
// readings have 3.
PC_EXPORT int32_t pc_filled_confidence(const pc_context* context, const float* before, const float* after,
                                       int64_t count, const uint8_t* confidence, const uint8_t* far,
                                       uint8_t* filled_confidence, int64_t* any_filled);

// -- points on depth images -------------------------------------------------------------------------------------------

// depth (num_views, height, width), 0 = no reading -> flying (num_views, height, width), 0 or 1: whether a reading has
// a neighbor of the eight across an edge and fewer than `least` on its own surface. Two readings share a surface where
// they differ by at most `tolerance` times the nearer.
PC_EXPORT int32_t pc_flying_pixels(const pc_context* context, const float* depth, int64_t num_views, int64_t height,
                                   int64_t width, double tolerance, int64_t least, uint8_t* flying);

// The same -> kept (num_views, height, width), without them; with confidence of that shape, else null, kept_confidence
// that is 0 there. With is_masked the images are those that pc_mask_depth would make first.
PC_EXPORT int32_t pc_without_flying_pixels(const pc_context* context, const float* depth, int64_t num_views,
                                           int64_t height, int64_t width, int64_t is_masked, double near, double far,
                                           const uint8_t* mask, double tolerance, int64_t least,
                                           const uint8_t* confidence, float* kept, uint8_t* kept_confidence);

// values (N,) of points on the pixels (N,), rising within each cloud, of images (height, width) -> medians (N,): the
// lower medians of the values that the 3 x 3 pixels around each have; those that are NaN do not count.
PC_EXPORT int32_t pc_window_medians(const pc_context* context, const float* values, const int64_t* pixel,
                                    const int64_t* ptr, int64_t num_clouds, int64_t height, int64_t width,
                                    float* medians);

// points (N, 3) on such pixels -> label (N,): 0, 1, ... in each cloud, the parts that are connected over pixels at most
// `reach` apart whose points are nearer than `limit` squared. Clouds hold less than 2^31 points.
PC_EXPORT int32_t pc_linked_pixels(const pc_context* context, const float* points, const int64_t* pixel,
                                   const int64_t* ptr, int64_t num_clouds, int64_t height, int64_t width, double limit,
                                   int64_t reach, int64_t* label);

// -- rendering --------------------------------------------------------------------------------------------------------

// points (N, 3) float64 in the frames of their cameras, intrinsics (views, 3, 3), lenses (views, 14) or null: twelve
// coefficients, not 0 for inverse Brown-Conrady, the radius where the model folds -> pixels (N, 2), NaN where none.
PC_EXPORT int32_t pc_project_points(const pc_context* context, const double* points, const int64_t* ptr, int64_t views,
                                    const double* intrinsics, const double* lenses, double* pixels);

// The nearest point at every pixel: depth (views, height, width), 0 where there is none, and index, its row, N where
// there is none. Cameras are those of pc_project_points; points are point_size wide. There are less than 2^32 points.
PC_EXPORT int32_t pc_render_points(const pc_context* context, const float* points, const int64_t* ptr, int64_t views,
                                   const double* intrinsics, const double* lenses, int64_t height, int64_t width,
                                   double point_size, float* depth, int64_t* index);

// The nearest point at every pixel of a spinning lidar's range images (views, beams, columns): depth, its distance, 0
// where there is none, and index, its row, N where there is none. A direction is in the row of the last of row_borders
// (beams + 1,) that -z / (sqrt(x^2 + y^2) + |z|) reaches, both rising, and in as many columns as it reaches
// column_borders (columns - 1,) with 1 + x / (|x| + |y|) where y >= 0, else 3 minus that quotient. Less than 2^32
// points.
PC_EXPORT int32_t pc_render_ranges(const pc_context* context, const float* points, const int64_t* ptr, int64_t views,
                                   int64_t beams, int64_t columns, const double* row_borders,
                                   const double* column_borders, float* depth, int64_t* index);

// The points (M, 3) of the positive pixels of range images, at cosine and sine of the elevation of each row (beams, 2)
// and of the azimuth of each column (columns, 2), and their pixel_index; those of each row of all images begin at
// starts (views * beams + 1,).
PC_EXPORT int32_t pc_deproject_ranges(const pc_context* context, const float* ranges, int64_t views, int64_t beams,
                                      int64_t columns, const int64_t* starts, const double* row_turns,
                                      const double* column_turns, float* points, int64_t* pixel_index);

// What the item (pixels,) in front has of values (N, 3), 0 where it is not below `items`: its row, or, with corners
// (items, num_corners), the sum of theirs, each times its weight (pixels, num_corners). As mixed (pixels, 3), or as
// bytes: 255 times that, rounded; either may be null.
PC_EXPORT int32_t pc_shade(const pc_context* context, const int64_t* item, int64_t pixels, int64_t items,
                           const int64_t* corners, const float* weights, int64_t num_corners, const float* values,
                           float* mixed, uint8_t* bytes);

// Rays (pixels, 2) against triangles, each within its box of an image: first (triangles,) pixel, across and down it;
// the normals (triangles, 3), offsets (triangles,) and sides (triangles, 3, 3) are those of math::meet. depth
// (pixels,), 0 where nothing is met, index of the nearest triangle, and weights (pixels, 3) of its corners.
PC_EXPORT int32_t pc_front_triangles(const pc_context* context, const int64_t* first, const int64_t* across,
                                     const int64_t* down, int64_t triangles, int64_t width, const double* rays,
                                     int64_t pixels, const double* normals, const double* offsets, const double* sides,
                                     float* depth, int64_t* index, float* weights);

// -- lenses -----------------------------------------------------------------------------------------------------------

// Invert a lens (14,) at bent coordinates (count, 2) by Newton's method inside the fold; NaN where `steps` steps do not
// come to `converged`.
PC_EXPORT int32_t pc_unbend(const pc_context* context, const double* bent, int64_t count, const double* lens,
                            int64_t steps, double converged, double* solved);

// Invert a fisheye lens of four coefficients at bent coordinates (count, 2): those whose angle theta off axis, at most
// the largest, is bent to theta (1 + k1 theta^2 + ...), which grows that far; NaN where there is none. At most `steps`
// steps, until the bent angle is `converged`.
PC_EXPORT int32_t pc_unbend_fisheye(const pc_context* context, const double* bent, int64_t count,
                                    const double* coefficients, double largest, int64_t steps, double converged,
                                    double* solved);

// Pixels of images (views, height, width, channels), either whole (uint8) or real (float), the other null, at places
// (views, out_pixels, 2) u, v -> sampled (views, out_pixels, channels) of the same type, and valid, 0 beyond the image.
// Bilinear, or the nearest pixel where nearest is not 0.
PC_EXPORT int32_t pc_sample_image(const pc_context* context, const uint8_t* whole, const float* real, int64_t views,
                                  int64_t height, int64_t width, int64_t channels, const double* places,
                                  int64_t out_pixels, int64_t nearest, uint8_t* sampled_whole, float* sampled_real,
                                  uint8_t* valid);

// Depths (views, height, width) at places (views, out_pixels, 2): the nearest reading, or with surface not 0 the mean
// of the inverse depths around where they differ by at most max_jump times the least; pixel_index is the nearest pixel,
// -1 beyond the image.
PC_EXPORT int32_t pc_sample_depth(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                  int64_t width, const double* places, int64_t out_pixels, int64_t surface,
                                  double max_jump, float* sampled, int64_t* pixel_index);

// -- neighbors --------------------------------------------------------------------------------------------------------

// queries null: the points; pixel null: no grid; neighbors have d2 <= limit, or <= that of their query where limits
// (Q,) is not null.
PC_EXPORT int32_t pc_neighbors(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                               const float* queries, const int64_t* queries_ptr, int64_t k, double limit,
                               const float* limits, const int64_t* pixel, int64_t width, const double* camera,
                               int64_t* index, float* distance);

// The same for points (N, width) and queries (Q, width), without a grid; rows are less than 2^32 - 1. norm: 0 straight
// distances, 1 sums of the columns' differences, 2 the largest of them; of those, limit is of the distance itself.
PC_EXPORT int32_t pc_wide_neighbors(const pc_context* context, const float* points, const int64_t* ptr,
                                    int64_t num_clouds, int64_t width, const float* queries, const int64_t* queries_ptr,
                                    int64_t k, double limit, int64_t norm, int64_t* index, float* distance);

// Points sorted into leaves (sum of ceil(n / 16), 64) with leaf_ptr (num_clouds + 1,), and boxes over them, 96 floats
// for every sixteen leaves, boxes of sixteen and so on of each cloud: both aligned to 64 bytes. Of consecutive equal
// points the lowest `copies` rows stay: kept (1,) of all.
PC_EXPORT int32_t pc_index_points(const pc_context* context, const float* points, const int64_t* ptr,
                                  int64_t num_clouds, int64_t copies, float* leaves, int64_t* leaf_ptr, float* boxes,
                                  int64_t* kept);

// As pc_neighbors, of points that were indexed with copies >= k, or all kept; queries null: the points, all kept.
PC_EXPORT int32_t pc_indexed_neighbors(const pc_context* context, const float* leaves, const int64_t* leaf_ptr,
                                       int64_t num_clouds, const float* boxes, int64_t num_points, const float* queries,
                                       const int64_t* queries_ptr, int64_t k, double limit, const float* limits,
                                       int64_t* index, float* distance);

// Points and queries that were indexed, all rows kept: counts (Q,) of the points with d2 < radius^2 of every query, of
// one radius for all or, with per_query not 0, of radii (Q,). exclude_self leaves out the row of the query's number.
PC_EXPORT int32_t pc_count_within(const pc_context* context, const float* leaves, const int64_t* leaf_ptr,
                                  int64_t num_clouds, const float* boxes, const float* groups, const int64_t* group_ptr,
                                  const float* radii, int64_t per_query, int64_t exclude_self, int64_t* counts);

// The points counted: query q has entries neighbors_ptr[q] to neighbors_ptr[q + 1] of index and distance, ascending by
// (squared distance, row).
PC_EXPORT int32_t pc_list_within(const pc_context* context, const float* leaves, const int64_t* leaf_ptr,
                                 int64_t num_clouds, const float* boxes, const float* groups, const int64_t* group_ptr,
                                 const float* radii, int64_t per_query, int64_t exclude_self,
                                 const int64_t* neighbors_ptr, int64_t* index, float* distance);

// squared (Q,) float: from every query to the nearest point of its cloud.
PC_EXPORT int32_t pc_nearest_squared(const pc_context* context, const float* points, const int64_t* ptr,
                                     int64_t num_clouds, const float* queries, const int64_t* queries_ptr,
                                     float* squared);

// Of the neighbors index (Q, k) of centers (Q, 3), num_points = missing, those last: mean (Q, 3), covariance (Q, 3, 3)
// of the population, and counts (Q,).
PC_EXPORT int32_t pc_neighborhood_shapes(const pc_context* context, const float* points, int64_t num_points,
                                         const int64_t* index, int64_t num_queries, int64_t k, const float* centers,
                                         float* mean, double* covariance, int64_t* counts);

// normals (N, 3) float; neighbors have d2 <= limit; pixel null: no grid. They are turned as by pc_face_normals unless
// viewpoint is null.
PC_EXPORT int32_t pc_normals(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                             int64_t max_neighbors, double limit, const int64_t* pixel, int64_t width,
                             const double* camera, const float* viewpoint, int64_t one_for_all, float* normals);

// facing (N, 3) = normals (N, 3), turned where they face away from the viewpoint, (N, 3) or one (3,) for all:
// normal . (viewpoint - point) < 0, in double.
PC_EXPORT int32_t pc_face_normals(const pc_context* context, const float* points, const float* normals, int64_t count,
                                  const float* viewpoint, int64_t one_for_all, float* facing);

// pixel null: no grid; mean (N,) double is working space, null: memory of the core's own. marks (N,): which points are
// outliers; or, unless kept_ptr is null, which are not, with kept_ptr and sums as pc_kept_rows gives them.
PC_EXPORT int32_t pc_statistical_outliers(const pc_context* context, const float* points, const int64_t* ptr,
                                          int64_t num_clouds, int64_t num_neighbors, double std_ratio,
                                          const int64_t* pixel, int64_t width, const double* camera, double* mean,
                                          uint8_t* marks, int64_t* kept_ptr, int64_t* sums);

// -- radius outliers and clusters -------------------------------------------------------------------------------------

// pixel (N,) rising within each cloud, or null; within (N,) are the points that there are, null = all: the others are
// no outliers; marks (N,), kept_ptr and sums as of pc_statistical_outliers; largest (1,) out: the largest cell
// coordinate of any cloud. The marks are complete only if that is below 2^36.
PC_EXPORT int32_t pc_radius_outlier_mask(const pc_context* context, const float* points, const int64_t* ptr,
                                         int64_t clouds, double radius, int64_t min_neighbors, const int64_t* pixel,
                                         int64_t width, const uint8_t* within, uint8_t* marks, int64_t* kept_ptr,
                                         int64_t* sums, double* largest);

// labels (N,) out; largest (1,) out: the largest cell coordinate of any cloud. The labels
// are complete only if that is below 2^36.
PC_EXPORT int32_t pc_dbscan(const pc_context* context, const float* points, const int64_t* ptr, int64_t clouds,
                            double eps, int64_t min_points, int64_t* labels, double* largest);

// -- sampling ---------------------------------------------------------------------------------------------------------

// points (num_rows, 3), of which those within, a mask, are all that there are; null: all are. ptr (num_clouds+1,) of
// these; wanted (num_clouds,), at most the points there are; picks (sum of wanted,): rows within each pick's own cloud,
// counted among those within; rows (sum of wanted,): of points, written where a mask is given. A cloud holds less than
// 2^31 points, and all rows less than 2^32 where a mask is given.
PC_EXPORT int32_t pc_farthest_points(const pc_context* context, const float* points, const int64_t* ptr,
                                     int64_t num_clouds, const uint8_t* within, int64_t num_rows, const int64_t* wanted,
                                     int64_t* picks, int64_t* rows);

// The same for all points of (N, width).
PC_EXPORT int32_t pc_wide_farthest_points(const pc_context* context, const float* points, const int64_t* ptr,
                                          int64_t num_clouds, int64_t width, const int64_t* wanted, int64_t* picks);

// points (N, 3); ptr (num_clouds+1,); sizes (num_clouds, 3); origins (num_clouds, 3), null: half a voxel below each
// cloud's lowest corner -> means (M, 3) in the first rows of (N, 3); inverse (N,); members (M,) in the first of (N,):
// how many points each voxel has; counts (num_clouds,): the voxels of each cloud. Clouds hold less than 2^31 points.
// *spans_too_many becomes 1, and nothing else is written, if a cloud spans 2^53 voxels or more.
PC_EXPORT int32_t pc_voxel_downsample(const pc_context* context, const float* points, const int64_t* ptr,
                                      int64_t num_clouds, const double* sizes, const double* origins, float* means,
                                      int64_t* inverse, int64_t* members, int64_t* counts, int64_t* spans_too_many);

// sizes (num_clouds,): the voxel size that leaves num_points of each cloud, or as few more as possible, found to the
// relative tolerance. *possible becomes 0, and nothing is certain, if a cloud has fewer distinct points or spans 2^53
// voxels of the size that would be needed.
PC_EXPORT int32_t pc_find_voxel_sizes(const pc_context* context, const float* points, const int64_t* ptr,
                                      int64_t num_clouds, int64_t num_points, double tolerance, double* sizes,
                                      int64_t* possible);

// -- planes -----------------------------------------------------------------------------------------------------------

// points (N, 3), ptr (num_clouds+1,), planes (num_clouds, 4) -> near (N,), 0 or 1: whether a point is near its cloud's.
PC_EXPORT int32_t pc_near_planes(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                                 const float* planes, double distance, uint8_t* near);

// points (N, 3), ptr (num_clouds+1,); planes (num_clouds, 4) become the least-squares planes of the points near them,
// again and again, at most `rounds` times, until those no longer change; the last that lies on no line, has 3 points
// near it and is within max_tilt of its cloud's up (num_clouds, 3) or null, or of -up, and the points near it -> near
// (N,). The same bits for any number of threads and any instruction set.
PC_EXPORT int32_t pc_refine_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                   int64_t num_clouds, double distance, const double* up, double max_tilt, double flat,
                                   int64_t rounds, double* planes, uint8_t* near);

// points (N, 3), ptr (num_clouds+1,) of clouds of three points or more, words (T, 3, num_draws) of 32 bits, which
// (num_clouds,) of the T each cloud takes, planes to try before those (num_clouds, 4) or null, unit vectors
// (num_clouds, 3) or null, max_tilt from them or -1, missed = log(1 - probability) or 0, 2^bits points of a cloud to
// count on if that is not 0, and the rounds of pc_refine_planes -> planes (num_clouds, 4) and near (N,) as ransac_plane
// describes them; found (num_clouds, 3): of what is tried how many are planes and how many of those compete, 0 unless
// fewer than 3 points are near the best; and how many points are.
PC_EXPORT int32_t pc_ransac_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                   int64_t num_clouds, const int64_t* words, int64_t num_draws, const int64_t* which,
                                   const double* guess, const double* up, double max_tilt, double distance,
                                   double missed, int64_t bits, double flat, int64_t rounds, double* planes,
                                   uint8_t* near, int64_t* found);

// points (N, 3), ptr (num_clouds+1,), near (N,) of 0 and 1, planes (num_clouds, 4) -> patch (N,): the points near its
// plane that are of each surface; corners (num_clouds, most_corners): rows of these, -1 behind the last; rms
// (num_clouds,): as plane_surfaces describes them. The rms is -1, and nothing else is written, where places are too far
// away to be numbered.
PC_EXPORT int32_t pc_plane_surfaces(const pc_context* context, const float* points, const int64_t* ptr,
                                    int64_t num_clouds, const uint8_t* near, const double* planes, double distance,
                                    int64_t most_corners, uint8_t* patch, int64_t* corners, double* rms);

// points (N, 3), ptr (num_clouds+1,), mask (N,) of 0 and 1, centers (num_clouds, 3) -> sums (num_clouds, 11) over the
// chosen points of each cloud, with p their offsets from its center: count, largest absolute coordinate, x, y, z, xx,
// xy, xz, yy, yz, zz. The same bits for any number of threads and any instruction set: eight lanes each add every
// eighth point of a piece, and pieces are added in order.
PC_EXPORT int32_t pc_moments(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                             const uint8_t* mask, const double* centers, double* sums);

// points (rows, 3), places (num_places, 3), one for all or one for each -> reach (rows,): their distances, of at least
// `least`.
PC_EXPORT int32_t pc_reach(const pc_context* context, const float* points, int64_t rows, const double* places,
                           int64_t num_places, double least, double* reach);

// points (count, 3) with reach (count,), a plane (4,) and its axes (3, 2), numbers (8,) as fit_surface lays them out ->
// height (count,) over the surface, and found (4,): noise, typical reach, clutter, and the points near the plane at
// first. Where these are less than 3, nothing else is certain.
PC_EXPORT int32_t pc_fit_surface(const pc_context* context, const float* points, int64_t count, const double* reach,
                                 const double* plane, const double* axes, const double* numbers, double* height,
                                 double* found);

// -- truncated signed distance fields ---------------------------------------------------------------------------------

// depth (height, width), rays (2, height, width), turn (3, 3) and fraction (3,) in blocks, camera (3,) blocks, offsets
// (num_offsets,) -> the sorted keys of the touched blocks, found (*count,), of room for every reading at every offset.
// *count becomes -1 if a block lies out of reach.
PC_EXPORT int32_t pc_tsdf_touched(const pc_context* context, const float* depth, const float* rays, int64_t height,
                                  int64_t width, const float* turn, const float* fraction, const int64_t* camera,
                                  const float* offsets, int64_t num_offsets, int64_t* found, int64_t* count);

// Bring a table of rows (num_slots,) up to date, from the first num_known rows of keys (num_blocks,) to all, and look
// up wanted (num_wanted,): rows (num_wanted,), -1 where there is no block; missing (*count,) are the keys of these.
PC_EXPORT int32_t pc_tsdf_find(const pc_context* context, const int64_t* keys, int64_t num_blocks, int32_t* slots,
                               int64_t num_slots, int64_t num_known, const int64_t* wanted, int64_t num_wanted,
                               int64_t* rows, int64_t* missing, int64_t* count);

// colors (count, 3) -> packed (count,): r | g << 10 | b << 20, in steps of a stored color.
PC_EXPORT int32_t pc_tsdf_pack_colors(const pc_context* context, const uint8_t* colors, int64_t count, int32_t* packed);

// Average one view into blocks rows (num_rows,), whose keys are keys[row]. planes: 6 arrays of chunk addresses (tsdf,
// weight, color, views, label, votes), null where absent. The images and `lens` may be null, as in tsdf::FusedView.
PC_EXPORT int32_t pc_tsdf_integrate(const pc_context* context, const float* depth, const int32_t* weight,
                                    const int32_t* color, const int32_t* label, int64_t height, int64_t width,
                                    const double* pose, double block_size, const float* steps, const float* pinhole,
                                    const float* lens, double scale, int64_t carve, const int64_t* rows,
                                    int64_t num_rows, const int64_t* keys, const int64_t* const* planes);

// Sorted block keys (count,) with their rows; planes as in pc_tsdf_integrate; what the weights of both ends must exceed
// -> counts (count,): how many edges of each block cross zero; marks (count, 24): which, 64 voxels of one z and an axis
// in a word; dropped (1,): how many more do, seen less.
PC_EXPORT int32_t pc_tsdf_count_crossings(const pc_context* context, const int64_t* keys, const int64_t* rows,
                                          int64_t count, const int64_t* const* planes, int64_t bound, int64_t* counts,
                                          int64_t* marks, int64_t* dropped);

// The same blocks with their marks and starts (count + 1,): where each block's points go -> edge (M,) or null,
// points (M, 3), normals (M, 3), weight (M,), views (M,), colors (M, 3) or null, labels (M,) or null.
PC_EXPORT int32_t pc_tsdf_write_crossings(const pc_context* context, const int64_t* keys, const int64_t* rows,
                                          int64_t count, const int64_t* const* planes, const int64_t* marks,
                                          const int64_t* starts, double voxel_size, int64_t* edge, float* points,
                                          float* normals, float* weight, int64_t* views, float* colors,
                                          int64_t* labels);

// Sorted block keys (count,) with their rows; planes as in pc_tsdf_integrate; what the weights of a cube's corners must
// exceed; the edges (num_edges,) of the vertices, rising -> signs (count, 16), edges (count, 32) for the calls below.
PC_EXPORT int32_t pc_tsdf_index_mesh(const pc_context* context, const int64_t* keys, const int64_t* rows, int64_t count,
                                     const int64_t* const* planes, int64_t bound, const int64_t* edge,
                                     int64_t num_edges, int64_t* signs, int64_t* edges);

// The table of cases (257,), (K, 3) -> counts (count,): the triangles of each block.
PC_EXPORT int32_t pc_tsdf_count_triangles(const pc_context* context, const int64_t* keys, int64_t count,
                                          const int64_t* signs, const int64_t* edges, const int64_t* table,
                                          const int64_t* corners, int64_t* counts);

// The same with starts (count + 1,): where each block's triangles go -> triangles (T, 3); used (num_edges,), all zero
// before: 1 where a vertex is in one.
PC_EXPORT int32_t pc_tsdf_write_triangles(const pc_context* context, const int64_t* keys, int64_t count,
                                          const int64_t* signs, const int64_t* edges, const int64_t* table,
                                          const int64_t* corners, const int64_t* starts, int64_t* triangles,
                                          uint8_t* used);

// Number (count,) entries anew, in place.
PC_EXPORT int32_t pc_tsdf_renumber(const pc_context* context, int64_t* entries, int64_t count, const int64_t* number);

// -- touching objects -------------------------------------------------------------------------------------------------

// Inverse depth (height, width), 0 = no reading; camera (4,) is fx, fy, cx, cy; limits (18,) as Python's Limits lists
// them, of lengths that scale with `scale` -> label (height, width) and normals (height, width, 3), as smooth_regions
// describes them.
PC_EXPORT int32_t pc_smooth_regions(const pc_context* context, const double* inverse, int64_t height, int64_t width,
                                    const double* camera, double noise, double scale, const double* limits,
                                    int64_t* label, double* normals);

// planes (count, 6) around pixels (count,) of the points of their own labels, as region_planes describes them.
PC_EXPORT int32_t pc_region_planes(const pc_context* context, const double* inverse, const int64_t* label,
                                   int64_t height, int64_t width, const double* camera, double scale,
                                   const double* limits, const int64_t* pixel, int64_t count, double* planes);
