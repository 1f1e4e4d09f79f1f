"""The functions of the compiled core, with the types of their arguments after the context that all take.

Written by core/write_signatures.py from core/pc/exports.hpp, which says what they do.
"""

# A hash of the declarations, which a library built from them has in it.
INTERFACE_NUMBER = 0x24DB2E908835824

DECLARATIONS = """
pc_advise_huge_pages: int64 count, int64* addresses, int64* bytes
pc_choose_pixels: float* depth, int64 views, int64 height, int64 width, float* column_rays, float* row_rays, float*
    rays, double near, double far, uint8* mask, double* matrices, float* lower, float* upper, uint8* keep, int64*
    readings, int64* starts, int64* possible
pc_deproject: float* depth, int64 views, int64 height, int64 width, float* column_rays, float* row_rays, float* rays,
    double* matrices, uint8* keep, int64* starts, float* points, int64* pixel_index, int64 over_all_views, uint8* rgb,
    float* colors, int64 num_copied, int64* sources, int64* pixel_bytes, int64* copies
pc_mask_depth: float* depth, int64 count, double near, double far, uint8* mask, float* masked
pc_look_at_depth: float* depth, int64 count, float* before, float* copy, float* extremes, int64* same
pc_register_depth: float* depth, int64 views, int64 height, int64 width, float* column_rays, float* row_rays, float*
    rays, double* color_from_depth, double* color_intrinsics, double* half_pixels, double* lenses, int64 color_height,
    int64 color_width, double max_jump, float* registered, int64* pixel_index, uint8* occluding, uint8* hidden, int64*
    possible
pc_kept_rows: uint8* marks, int64 gone, uint8* within, int64* ptr, int64 num_clouds, uint8* keep, int64* kept_ptr,
    int64* sums
pc_keep_rows: uint8* mask, int64 rows, int64 room, int64 num_fields, int64* sources, int64* row_bytes, int64* picked,
    int64* kept
pc_gather_kept: int64* ptr, int64 num_clouds, uint8* kept, int64* kept_ptr, int64 num_fields, int64* sources, int64*
    row_bytes, int64* picked
pc_take_rows: int64* index, int64 num_picked, int64 rows, int64 num_fields, int64* sources, int64* row_bytes, int64*
    picked, int64* possible
pc_place_rows: int64 num_parts, int64* counts, int64* starts, int64 num_fields, int64* sources, int64* row_bytes, int64*
    fillers, int64* blocks
pc_find_records: int64* places, int64 num_records, int64* firsts, int64* which, int64 num_groups, int64 form, int64*
    tables, int64* pointers, int64 num_columns, int64* row_bytes, int64* roles, int64* table
pc_gather_records: int64 num_records, int64 num_columns, int64* row_bytes, int64* roles, int64* table, uint8* into
pc_transform_points: float* points, int64* ptr, int64 num_clouds, double* matrices, float* moved
pc_transform_directions: float* directions, int64* ptr, int64 num_clouds, double* linear, float* turned
pc_move_points: float* points, int64* sources, int64* ptr, int64 num_clouds, int64 num_steps, int64* is_noise, double*
    matrices, int64* seeds, double* sigma, double* clip, uint8* kept, int64* kept_ptr, float* moved
pc_draw_motions: int64* keys, int64 num_clouds, double* draws, int64 num_draws, int64 num_steps, double* matrices
pc_led_back: double* matrices, int64 num_steps, int64 num_clouds, double* source_from_cloud, double* result, int64*
    possible
pc_are_plain_motions: double* matrices, int64 count, int64* plain
pc_random_order: int64 num_clouds, int64* counts, int64* wanted, int64* seeds, int64* rows
pc_dropped_rows: int64* keys, int64* ptr, int64 num_clouds, double low, double high, uint8* mask, int64* kept_ptr
pc_inside_box: float* points, int64 rows, float* lower, float* upper, uint8* inside, int64* finite
pc_box_mask: float* points, int64* ptr, int64 num_clouds, float* lower, float* upper, uint8* inside
pc_polygon_mask: float* points, int64 rows, double* corners, int64 num_corners, uint8* inside
pc_duplicate_mask: float* points, int64* ptr, int64 num_clouds, uint8* repeats
pc_convex_hull: double* points, int64 count, int64* corners, int64* num_corners
pc_points_in_grippers: float* points, int64 count, double* axes, double* origin, double* lower, double* upper, int64
    num_grasps, int64* hits, int64* held
pc_reciprocals: float* values, float* scales, int64 views, int64 pixels, float* reciprocals
pc_spatial_filter: float* values, float* scales, int64 views, int64 height, int64 width, double keep, double delta,
    int64 iterations, float* smoothed
pc_temporal_filter: float* values, float* scales, int64 views, int64 pixels, double keep, double delta, int64 needed,
    int64 frames, float* last, uint8* history, float* filtered, float* new_last, uint8* new_history
pc_bilateral_filter: float* depth, int64 views, int64 height, int64 width, int64 reach, float* shares, double scale,
    double max_jump, float* smoothed
pc_median_filter: float* depth, int64 views, int64 height, int64 width, int64 reach, double max_jump, float* found
pc_fill_holes: float* depth, int64 views, int64 height, int64 width, int64 rule, int64 max_size, float* filled, int64*
    distance, int64 limit, uint8* far
pc_fill_rows: float* values, int64 rows, int64 width, int64 radius, float* filled
pc_filled_confidence: float* before, float* after, int64 count, uint8* confidence, uint8* far, uint8* filled_confidence,
    int64* any_filled
pc_flying_pixels: float* depth, int64 num_views, int64 height, int64 width, double tolerance, int64 least, uint8* flying
pc_without_flying_pixels: float* depth, int64 num_views, int64 height, int64 width, int64 is_masked, double near, double
    far, uint8* mask, double tolerance, int64 least, uint8* confidence, float* kept, uint8* kept_confidence
pc_window_medians: float* values, int64* pixel, int64* ptr, int64 num_clouds, int64 height, int64 width, float* medians
pc_linked_pixels: float* points, int64* pixel, int64* ptr, int64 num_clouds, int64 height, int64 width, double limit,
    int64 reach, int64* label
pc_project_points: double* points, int64* ptr, int64 views, double* intrinsics, double* lenses, double* pixels
pc_render_points: float* points, int64* ptr, int64 views, double* intrinsics, double* lenses, int64 height, int64 width,
    double point_size, float* depth, int64* index
pc_render_ranges: float* points, int64* ptr, int64 views, int64 beams, int64 columns, double* row_borders, double*
    column_borders, float* depth, int64* index
pc_deproject_ranges: float* ranges, int64 views, int64 beams, int64 columns, int64* starts, double* row_turns, double*
    column_turns, float* points, int64* pixel_index
pc_shade: int64* item, int64 pixels, int64 items, int64* corners, float* weights, int64 num_corners, float* values,
    float* mixed, uint8* bytes
pc_front_triangles: int64* first, int64* across, int64* down, int64 triangles, int64 width, double* rays, int64 pixels,
    double* normals, double* offsets, double* sides, float* depth, int64* index, float* weights
pc_unbend: double* bent, int64 count, double* lens, int64 steps, double converged, double* solved
pc_unbend_fisheye: double* bent, int64 count, double* coefficients, double largest, int64 steps, double converged,
    double* solved
pc_sample_image: uint8* whole, float* real, int64 views, int64 height, int64 width, int64 channels, double* places,
    int64 out_pixels, int64 nearest, uint8* sampled_whole, float* sampled_real, uint8* valid
pc_sample_depth: float* depth, int64 views, int64 height, int64 width, double* places, int64 out_pixels, int64 surface,
    double max_jump, float* sampled, int64* pixel_index
pc_neighbors: float* points, int64* ptr, int64 num_clouds, float* queries, int64* queries_ptr, int64 k, double limit,
    float* limits, int64* pixel, int64 width, double* camera, int64* index, float* distance
pc_wide_neighbors: float* points, int64* ptr, int64 num_clouds, int64 width, float* queries, int64* queries_ptr, int64
    k, double limit, int64 norm, int64* index, float* distance
pc_index_points: float* points, int64* ptr, int64 num_clouds, int64 copies, float* leaves, int64* leaf_ptr, float*
    boxes, int64* kept
pc_indexed_neighbors: float* leaves, int64* leaf_ptr, int64 num_clouds, float* boxes, int64 num_points, float* queries,
    int64* queries_ptr, int64 k, double limit, float* limits, int64* index, float* distance
pc_count_within: float* leaves, int64* leaf_ptr, int64 num_clouds, float* boxes, float* groups, int64* group_ptr, float*
    radii, int64 per_query, int64 exclude_self, int64* counts
pc_list_within: float* leaves, int64* leaf_ptr, int64 num_clouds, float* boxes, float* groups, int64* group_ptr, float*
    radii, int64 per_query, int64 exclude_self, int64* neighbors_ptr, int64* index, float* distance
pc_nearest_squared: float* points, int64* ptr, int64 num_clouds, float* queries, int64* queries_ptr, float* squared
pc_neighborhood_shapes: float* points, int64 num_points, int64* index, int64 num_queries, int64 k, float* centers,
    float* mean, double* covariance, int64* counts
pc_normals: float* points, int64* ptr, int64 num_clouds, int64 max_neighbors, double limit, int64* pixel, int64 width,
    double* camera, float* viewpoint, int64 one_for_all, float* normals
pc_face_normals: float* points, float* normals, int64 count, float* viewpoint, int64 one_for_all, float* facing
pc_statistical_outliers: float* points, int64* ptr, int64 num_clouds, int64 num_neighbors, double std_ratio, int64*
    pixel, int64 width, double* camera, double* mean, uint8* marks, int64* kept_ptr, int64* sums
pc_radius_outlier_mask: float* points, int64* ptr, int64 clouds, double radius, int64 min_neighbors, int64* pixel, int64
    width, uint8* within, uint8* marks, int64* kept_ptr, int64* sums, double* largest
pc_dbscan: float* points, int64* ptr, int64 clouds, double eps, int64 min_points, int64* labels, double* largest
pc_farthest_points: float* points, int64* ptr, int64 num_clouds, uint8* within, int64 num_rows, int64* wanted, int64*
    picks, int64* rows
pc_wide_farthest_points: float* points, int64* ptr, int64 num_clouds, int64 width, int64* wanted, int64* picks
pc_voxel_downsample: float* points, int64* ptr, int64 num_clouds, double* sizes, double* origins, float* means, int64*
    inverse, int64* members, int64* counts, int64* spans_too_many
pc_find_voxel_sizes: float* points, int64* ptr, int64 num_clouds, int64 num_points, double tolerance, double* sizes,
    int64* possible
pc_near_planes: float* points, int64* ptr, int64 num_clouds, float* planes, double distance, uint8* near
pc_refine_planes: float* points, int64* ptr, int64 num_clouds, double distance, double* up, double max_tilt, double
    flat, int64 rounds, double* planes, uint8* near
pc_ransac_planes: float* points, int64* ptr, int64 num_clouds, int64* words, int64 num_draws, int64* which, double*
    guess, double* up, double max_tilt, double distance, double missed, int64 bits, double flat, int64 rounds, double*
    planes, uint8* near, int64* found
pc_plane_surfaces: float* points, int64* ptr, int64 num_clouds, uint8* near, double* planes, double distance, int64
    most_corners, uint8* patch, int64* corners, double* rms
pc_moments: float* points, int64* ptr, int64 num_clouds, uint8* mask, double* centers, double* sums
pc_reach: float* points, int64 rows, double* places, int64 num_places, double least, double* reach
pc_fit_surface: float* points, int64 count, double* reach, double* plane, double* axes, double* numbers, double* height,
    double* found
pc_tsdf_touched: float* depth, float* rays, int64 height, int64 width, float* turn, float* fraction, int64* camera,
    float* offsets, int64 num_offsets, int64* found, int64* count
pc_tsdf_find: int64* keys, int64 num_blocks, int32* slots, int64 num_slots, int64 num_known, int64* wanted, int64
    num_wanted, int64* rows, int64* missing, int64* count
pc_tsdf_pack_colors: uint8* colors, int64 count, int32* packed
pc_tsdf_integrate: float* depth, int32* weight, int32* color, int32* label, int64 height, int64 width, double* pose,
    double block_size, float* steps, float* pinhole, float* lens, double scale, int64 carve, int64* rows, int64
    num_rows, int64* keys, int64* planes
pc_tsdf_count_crossings: int64* keys, int64* rows, int64 count, int64* planes, int64 bound, int64* counts, int64* marks,
    int64* dropped
pc_tsdf_write_crossings: int64* keys, int64* rows, int64 count, int64* planes, int64* marks, int64* starts, double
    voxel_size, int64* edge, float* points, float* normals, float* weight, int64* views, float* colors, int64* labels
pc_tsdf_index_mesh: int64* keys, int64* rows, int64 count, int64* planes, int64 bound, int64* edge, int64 num_edges,
    int64* signs, int64* edges
pc_tsdf_count_triangles: int64* keys, int64 count, int64* signs, int64* edges, int64* table, int64* corners, int64*
    counts
pc_tsdf_write_triangles: int64* keys, int64 count, int64* signs, int64* edges, int64* table, int64* corners, int64*
    starts, int64* triangles, uint8* used
pc_tsdf_renumber: int64* entries, int64 count, int64* number
pc_smooth_regions: double* inverse, int64 height, int64 width, double* camera, double noise, double scale, double*
    limits, int64* label, double* normals
pc_region_planes: double* inverse, int64* label, int64 height, int64 width, double* camera, double scale, double*
    limits, int64* pixel, int64 count, double* planes
"""
