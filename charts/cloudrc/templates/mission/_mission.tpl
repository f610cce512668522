{{/* A mission as a file. Argument: (dict "root" $ "plan" NAME-OR-MAPPING "key" KEY-IN-THE-VALUES). */}}
{{- define "cloudrc.missionFile" -}}
{{- if kindIs "map" .plan -}}
{{ toYaml .plan }}
{{- else -}}
{{- $text := .root.Files.Get (printf "files/missions/%s.yaml" .plan) -}}
{{- if not $text -}}
{{- $known := list -}}
{{- range $path, $_ := .root.Files.Glob "files/missions/*.yaml" -}}
{{- $known = append $known (base $path | trimSuffix ".yaml") -}}
{{- end -}}
{{- fail (printf "%s: no mission '%s' ships with the chart; choose one of %s, or write the mission there" .key .plan (join ", " $known)) -}}
{{- end -}}
{{ $text | trimSuffix "\n" }}
{{- end -}}
{{- end }}

{{/* Whether the Job of a mission leaves a report in the volume of the recordings: "true" or "". */}}
{{- define "cloudrc.keepsReports" -}}
{{- if and (include "cloudrc.recordingsClaim" .) (not (include "cloudrc.isFleet" .)) }}true{{ end -}}
{{- end }}

{{/* The name of a CronJob has at most 52 characters. */}}
{{- define "cloudrc.cronJobName" -}}
{{ include "cloudrc.fullname" . | trunc 44 | trimSuffix "-" }}-mission
{{- end }}

{{/* The container that posts a mission, follows it and ends with its verdict.
     Argument: (dict "root" $ "name" NAME "uid" FIELD "queue" BOOL "number" ROBOT), of a fleet the robot.
     With a claim for recordings, that of a mission, not of a test, leaves a report there. */}}
{{- define "cloudrc.missionContainer" -}}
{{- $reports := and (eq .name "mission") (include "cloudrc.keepsReports" .root) -}}
{{- $resources := deepCopy .root.Values.mission.resources -}}
{{- if $reports -}}
{{- $_ := set $resources "limits" (merge (dict "memory" .root.Values.recordings.memory) ($resources.limits | default dict)) -}}
{{- end -}}
- name: {{ .name }}
  image: {{ include "cloudrc.image" (dict "root" .root "role" "cloud") }}
  imagePullPolicy: {{ .root.Values.image.pullPolicy }}
  args:
    - mission
    - fly
    {{- if include "cloudrc.isFleet" .root }}
    - --api=http://{{ include "cloudrc.hostOf" (dict "root" .root "component" (include "cloudrc.cloudPods" .root) "number" (.number | default "0")) }}:8080
    {{- else }}
    - --api=http://{{ include "cloudrc.fullname" .root }}-api:{{ .root.Values.teleop.service.port }}
    {{- end }}
    - --token-file=/etc/cloudrc-tokens/operator
    - --mission=/etc/cloudrc-mission/mission.yaml
    - --key=$(MISSION_KEY)
    - --lease={{ .root.Values.mission.leaseSeconds }}
    {{- if .queue }}
    - --queue
    {{- end }}
    {{- if $reports }}
    - --report=/var/lib/cloudrc
    - --config=/etc/cloudrc/experiment.yaml
    - --profile=/etc/cloudrc-link/profile.yaml
    - --keep={{ .root.Values.recordings.keepMissions }}
    - --keep-days={{ .root.Values.recordings.keepDays }}
    {{- with include "cloudrc.recordingShare" .root }}
    - --keep-size={{ . }}
    {{- end }}
    {{- end }}
  env:
    # Posting twice under one key flies once.
    - name: MISSION_KEY
      valueFrom:
        fieldRef:
          fieldPath: {{ .uid }}
    {{- with .root.Values.mission.extraEnv }}
    {{- toYaml . | nindent 4 }}
    {{- end }}
  terminationMessagePolicy: FallbackToLogsOnError
  {{- include "cloudrc.containerSecurity" .root | nindent 2 }}
  resources:
    {{- toYaml $resources | nindent 4 }}
  volumeMounts:
    - {name: mission, mountPath: /etc/cloudrc-mission, readOnly: true}
    - {name: tokens, mountPath: /etc/cloudrc-tokens, readOnly: true}
    {{- if $reports }}
    {{- include "cloudrc.experimentMounts" .root | nindent 4 }}
    - {name: link, mountPath: /etc/cloudrc-link, readOnly: true}
    - {{ include "cloudrc.dataMount" .root | replace "(ROBOT)" "(JOB_COMPLETION_INDEX)" }}
    {{- end }}
    {{- include "cloudrc.extraMounts" .root.Values.mission | nindent 4 }}
{{- end }}

{{/* Volumes of a pod that flies a mission. Argument: (dict "root" $ "name" CONFIGMAP "reports" BOOL). */}}
{{- define "cloudrc.missionVolumes" -}}
- name: mission
  configMap:
    name: {{ .name }}
- name: tokens
  secret:
    secretName: {{ include "cloudrc.tokensName" .root }}
    defaultMode: 0440
    items:
      - {key: operator, path: operator}
{{- if and .reports (include "cloudrc.keepsReports" .root) }}
{{ include "cloudrc.experimentVolumes" .root }}
- name: link
  configMap:
    name: {{ include "cloudrc.fullname" .root }}-link
- name: data
  persistentVolumeClaim:
    claimName: {{ include "cloudrc.recordingsClaim" .root }}
{{- end }}
{{- with .root.Values.mission.extraVolumes }}
{{ toYaml . }}
{{- end }}
{{- end }}

{{/* Spec of a Job that flies a mission. Argument: (dict "root" $ "name" CONFIGMAP "queue" BOOL). */}}
{{- define "cloudrc.missionJobSpec" -}}
# A failed mission is not flown again automatically.
{{- if include "cloudrc.isFleet" .root }}
backoffLimitPerIndex: 0
completionMode: Indexed
completions: {{ include "cloudrc.robots" .root }}
parallelism: {{ include "cloudrc.robots" .root }}
{{- else }}
backoffLimit: 0
{{- end }}
# A stopped watcher ends nothing: a new pod follows the mission.
podFailurePolicy:
  rules:
    - action: Ignore
      onPodConditions: [{type: DisruptionTarget, status: "True"}]
    - action: Ignore
      onExitCodes: {containerName: mission, operator: In, values: [137, 143]}
activeDeadlineSeconds: {{ .root.Values.mission.activeDeadlineSeconds }}
ttlSecondsAfterFinished: {{ .root.Values.mission.ttlSecondsAfterFinished }}
template:
  metadata:
    labels:
      {{- include "cloudrc.podLabels" (dict "root" .root "component" "mission" "more" .root.Values.mission.podLabels) | nindent 6 }}
    {{- with .root.Values.mission.podAnnotations }}
    annotations:
      {{- toYaml . | nindent 6 }}
    {{- end }}
  spec:
    restartPolicy: Never
    {{- include "cloudrc.pod" (dict "root" .root "component" "cloud") | nindent 4 }}
    {{- with include "cloudrc.placement" .root.Values.cloud }}
    {{- . | nindent 4 }}
    {{- end }}
    containers:
      {{- include "cloudrc.missionContainer" (dict "root" .root "name" "mission" "uid" "metadata.labels['batch.kubernetes.io/controller-uid']" "queue" .queue "number" "$(JOB_COMPLETION_INDEX)") | nindent 6 }}
    volumes:
      {{- include "cloudrc.missionVolumes" (dict "root" .root "name" .name "reports" true) | nindent 6 }}
{{- end }}
