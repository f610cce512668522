{{/* Common parts of the pods: security contexts, probes, volumes. */}}

{{/* Start of a pod's spec; it satisfies Pod Security "restricted". */}}
{{- define "cloudrc.pod" -}}
serviceAccountName: {{ include "cloudrc.serviceAccountName" . }}
automountServiceAccountToken: false
enableServiceLinks: false
{{- with (.root.Values.scheduling | default dict).schedulerName }}
schedulerName: {{ . }}
{{- end }}
{{- with .root.Values.podSecurityContext }}
securityContext:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with concat ((.root.Values.global | default dict).imagePullSecrets | default list) .root.Values.image.pullSecrets }}
imagePullSecrets:
  {{- range . }}
  - name: {{ kindIs "map" . | ternary (get (kindIs "map" . | ternary . dict) "name") . }}
  {{- end }}
{{- end }}
{{- end }}

{{/* Security context of a container. Argument: the root. */}}
{{- define "cloudrc.containerSecurity" -}}
{{- with .Values.containerSecurityContext -}}
securityContext:
  {{- toYaml . | nindent 2 }}
{{- end -}}
{{- end }}

{{/* Probes on the metrics port. Readiness needs the peer, liveness does not: the guard handles a lost
     link, and a restart would not help. On a busy node a link, which asks for little CPU, answers late, but
     still delays packets: a restart would interrupt the flight. */}}
{{- define "cloudrc.probes" -}}
startupProbe:
  httpGet: {path: /healthz, port: {{ . }}}
  periodSeconds: 1
  failureThreshold: 180
readinessProbe:
  httpGet: {path: /readyz, port: {{ . }}}
  periodSeconds: 2
  timeoutSeconds: 2
livenessProbe:
  httpGet: {path: /healthz, port: {{ . }}}
  periodSeconds: 10
  timeoutSeconds: {{ eq . "link-metrics" | ternary 10 5 }}
  failureThreshold: {{ eq . "link-metrics" | ternary 18 3 }}
{{- end }}

{{/* Additional environment of a container without one of its own. Argument: its values. */}}
{{- define "cloudrc.extraEnv" -}}
{{- with .extraEnv -}}
env:
  {{- toYaml . | nindent 2 }}
{{- end -}}
{{- end }}

{{- define "cloudrc.extraMounts" -}}
{{- with .extraVolumeMounts -}}
{{ toYaml . }}
{{- end -}}
{{- end }}

{{/* Common parts of the containers with ROS 2. DDS stays inside the pod, whose containers share the
     loopback address. Logs of ROS are in /tmp. Argument: (dict "root" $ "of" VALUES), the values of
     the container. */}}
{{- define "cloudrc.rosSettings" -}}
env:
  - {name: ROS_AUTOMATIC_DISCOVERY_RANGE, value: LOCALHOST}
  - {name: HOME, value: /tmp}
  {{- with include "cloudrc.robotVariable" .root }}
  {{- . | nindent 2 }}
  {{- end }}
  {{- with .of.extraEnv }}
  {{- toYaml . | nindent 2 }}
  {{- end }}
terminationMessagePolicy: FallbackToLogsOnError
{{ include "cloudrc.containerSecurity" .root }}
resources:
  {{- toYaml .of.resources | nindent 2 }}
{{- end }}

{{/* With LOCALHOST, Fast DDS always takes messages through /dev/shm: a volume, because not every runtime
     lets containers share it, and those without ROS need not. /tmp is each container's own: Python
     would run what another one writes there, because it is HOME. Argument: (dict "of" VALUES "name" NAME), the values and the name of the container. */}}
{{- define "cloudrc.rosMounts" -}}
- {name: tmp-{{ .name }}, mountPath: /tmp}
- {name: shm, mountPath: /dev/shm}
{{- with include "cloudrc.extraMounts" .of }}
{{ . }}
{{- end }}
{{- end }}

{{- define "cloudrc.placement" -}}
{{- with .priorityClassName }}
priorityClassName: {{ . }}
{{- end }}
{{- with .runtimeClassName }}
runtimeClassName: {{ . }}
{{- end }}
{{- with .nodeSelector }}
nodeSelector:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .tolerations }}
tolerations:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .affinity }}
affinity:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .topologySpreadConstraints }}
topologySpreadConstraints:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end }}

{{/* Annotations of a pod. A changed experiment, robot or scene restarts the pod, a changed link profile
     does not. */}}
{{- define "cloudrc.podAnnotations" -}}
{{- $experiment := printf "%s%s" (include "cloudrc.experiment" .root) (include "cloudrc.ownFiles" .root) -}}
{{- $made := dict "checksum/experiment" (sha256sum $experiment) -}}
{{- $_ := set $made "cloudrc/link-mode" (include "cloudrc.linkMode" .root) -}}
{{- $_ := set $made "kubectl.kubernetes.io/default-container" .component -}}
{{- if .root.Values.metrics.annotations -}}
{{- $scrape := dict "prometheus.io/scrape" "true" "prometheus.io/path" "/metrics" "prometheus.io/port" "9100" -}}
{{- $made = merge $made $scrape -}}
{{- end -}}
{{- /* The user's podAnnotations override the ones made here. */ -}}
{{ toYaml (merge (deepCopy (index .root.Values .component).podAnnotations) $made) }}
{{- end }}

{{/* Volumes of both pods: experiment, link profile, key, the route file of the link, recordings. */}}
{{- define "cloudrc.volumes" -}}
{{- $name := include "cloudrc.fullname" .root -}}
{{ include "cloudrc.experimentVolumes" .root }}
- name: link
  configMap:
    name: {{ $name }}-link
- name: secret
  secret:
    secretName: {{ include "cloudrc.secretName" .root }}
    defaultMode: 0440
- name: run
  emptyDir:
    medium: Memory
    sizeLimit: 4Mi
- name: data
  {{- with include "cloudrc.recordingsClaim" .root }}
  persistentVolumeClaim:
    claimName: {{ . }}
  {{- else }}
  emptyDir:
    sizeLimit: {{ (index .root.Values .component).recordingSizeLimit }}
  {{- end }}
{{- end }}

{{/* Name of the claim for recordings and reports; "" without one. */}}
{{- define "cloudrc.recordingsClaim" -}}
{{- $made := .Values.recordings.storage | empty | ternary "" (printf "%s-recordings" (include "cloudrc.fullname" .)) -}}
{{- .Values.recordings.existingClaim | default $made -}}
{{- end }}

{{/* A quantity such as 1Gi as a number [bytes]. */}}
{{- define "cloudrc.bytes" -}}
{{- $unit := toString . | regexFind "[kKMGT]i?$" -}}
{{- $decimal := dict "" 1 "k" 1e3 "M" 1e6 "G" 1e9 "T" 1e12 -}}
{{- $binary := dict "Ki" 1024 "Mi" 1048576 "Gi" 1073741824 "Ti" 1099511627776 -}}
{{- mulf (toString . | trimSuffix $unit | float64) (get (merge $decimal $binary) $unit) | int64 -}}
{{- end }}

{{/* What each of world, cloud and the kept reports of a robot may take of recordings.storage, a quarter
     [bytes]: the last one is for a report that is written. "" without this value. */}}
{{- define "cloudrc.recordingShare" -}}
{{- with .Values.recordings.storage -}}
{{- div (include "cloudrc.bytes" .) (mul 4 (include "cloudrc.robots" $)) -}}
{{- end -}}
{{- end }}

{{/* Limit of the recordings of a component. Argument: (dict "root" $ "component" NAME). */}}
{{- define "cloudrc.recordMax" -}}
{{- $own := (index .root.Values .component).recordingSizeLimit -}}
{{- $share := include "cloudrc.recordingShare" .root | default $own -}}
{{- lt (include "cloudrc.bytes" $share | int64) (include "cloudrc.bytes" $own | int64) | ternary $share $own -}}
{{- end }}

{{/* Mount of this volume; several releases, and the robots of a fleet, may share a claim. */}}
{{- define "cloudrc.dataMount" -}}
{{- $folder := printf "subPath: %s" (include "cloudrc.fullname" .) -}}
{{- if include "cloudrc.isFleet" . -}}
{{- $folder = printf "subPathExpr: %s/$(ROBOT)" (include "cloudrc.fullname" .) -}}
{{- end -}}
{name: data, mountPath: /var/lib/cloudrc{{ if include "cloudrc.recordingsClaim" . }}, {{ $folder }}{{ end }}}
{{- end }}

{{/* Volume mounts of world and cloud. Argument: the root. */}}
{{- define "cloudrc.endMounts" -}}
{{ include "cloudrc.experimentMounts" . }}
- {name: secret, mountPath: /etc/cloudrc-secret, readOnly: true}
- {name: run, mountPath: /run/cloudrc}
- {{ include "cloudrc.dataMount" . }}
{{- end }}
